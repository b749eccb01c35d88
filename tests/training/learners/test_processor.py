import gymnasium
import torch

from training.learners.processor import fast_products, keep_memory
from training.modules.encoder import Encoder, has_bfloat16


def test_products_are_close_and_the_setting_is_restored() -> None:
    torch.manual_seed(0)
    left, right = torch.randn(512, 256), torch.randn(256, 256)
    exact = left.double() @ right.double()
    before = torch.backends.mkldnn.matmul.fp32_precision
    keep_memory()
    with fast_products():
        # The factors have 8 significant bits where the processor multiplies bfloat16.
        torch.testing.assert_close((left @ right).double(), exact, atol=0.3, rtol=0.02)
    assert torch.backends.mkldnn.matmul.fp32_precision == before
    torch.testing.assert_close((left @ right).double(), exact, atol=1e-3, rtol=1e-5)


def test_encoders_round_only_while_learning_and_only_where_the_processor_multiplies_bfloat16() -> None:
    torch.manual_seed(0)
    space = gymnasium.spaces.Dict(observation=gymnasium.spaces.Box(-1, 1, (16,)))
    encoder, observations = Encoder(space, hidden=(32,)), {"observation": torch.rand(8, 16)}
    exact = encoder(observations)
    with fast_products():
        rounded = encoder(observations)
    assert rounded.dtype == torch.float32
    assert torch.equal(rounded, rounded.bfloat16().float()) == has_bfloat16()
    torch.testing.assert_close(rounded, exact, atol=0.05, rtol=0.02)
    assert torch.equal(encoder(observations), exact)
