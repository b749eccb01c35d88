import torch

from training.modules.recurrent import GRULayer


def test_the_layer_equals_torchs_gru_cell() -> None:
    torch.manual_seed(0)
    own, theirs = GRULayer(5, 4), torch.nn.GRUCell(5, 4)
    with torch.no_grad():
        own.from_input.bias.normal_()
        own.from_hidden.bias.normal_()
        theirs.weight_ih.copy_(own.from_input.weight)
        theirs.weight_hh.copy_(own.from_hidden.weight)
        theirs.bias_ih.copy_(own.from_input.bias)
        theirs.bias_hh.copy_(own.from_hidden.bias)
    inputs, hidden = torch.randn(7, 5), torch.randn(7, 4)
    torch.testing.assert_close(own(inputs, hidden), theirs(inputs, hidden))
