import torch

from training.learners.processor import fast_products, keep_memory


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
