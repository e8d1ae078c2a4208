"""Torch settings that results depend on: number of threads and precision."""

import contextlib
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """Compute with so many threads for a while. Sums are split differently among another number, so their last bits would depend on the machine."""
    import torch

    before = torch.get_num_threads()
    if before != count:
        torch.set_num_threads(count)
    try:
        yield
    finally:
        if before != count:
            torch.set_num_threads(before)


@contextlib.contextmanager
def threads_where_imported(count: int) -> Iterator[None]:
    """`threads`, unless torch has not been imported: that takes seconds, and there is nothing to compute with it then."""
    with threads(count) if "torch" in sys.modules else contextlib.nullcontext():
        yield


def computes_bfloat16(device: str) -> bool:
    """Whether a device multiplies in bfloat16 itself; models are trained in float32 where not.

    On a processor that does not (AVX2 without AVX-512, say) oneDNN has no such convolution
    (https://uxlfoundation.github.io/oneDNN/dev_guide_data_types.html), and PyTorch falls back on one that took ten times as long as in float32.

    Args:
        device: of torch, such as `cpu`, `cuda` or `cuda:1`.
    """
    import torch

    if device.partition(":")[0] == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    return bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
