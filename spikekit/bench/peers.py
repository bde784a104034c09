"""Functions of other projects, where they are installed: each import happens inside the function that needs it."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor


def spikezoo_load(path: str, height: int, width: int, version: str) -> Callable[[], Tensor]:
    """Spike-Zoo's reader, in Python or in C++; it always turns the frames and gives float32."""
    load = _spikezoo().load_vidar_dat
    if version == "cpp":
        import spikezoo.utils.vidar_loader  # noqa: F401  built for one version of Python
    return lambda: load(path, height, width, version=version, out_format="tensor")


def spikezoo_save(path: str, spikes: Tensor) -> Callable[[], None]:
    """Spike-Zoo's writer."""
    save, array = _spikezoo().save_vidar_dat, spikes.numpy()
    return lambda: save(path, array)


def spikezoo_tfi(spikes: Tensor) -> Callable[[], Tensor]:
    """Spike-Zoo's TFI of the middle frame."""
    _spikezoo()
    from spikezoo.archs.tfi.nets import TFIModel

    model, clip = TFIModel(len(spikes)), spikes.float()[None]
    model.device = clip.device
    return lambda: model(clip)[0, 0]


def spikezoo_simulate(light: Tensor, seed: int) -> Callable[[], Tensor]:
    """Spike-Zoo's simulator; the charge that it starts from comes out of NumPy's global generator."""
    simulate, array = _spikezoo().video2spike_simulation, light.numpy()

    def run() -> Tensor:
        np.random.seed(seed)  # noqa: NPY002
        return torch.from_numpy(simulate(array, threshold=1.0))

    return run


def spikezoo_charge(height: int, width: int, seed: int) -> Tensor:
    """Return the charge that :func:`spikezoo_simulate` starts from."""
    return torch.from_numpy(np.random.RandomState(seed).random((height, width))).float()


def spikingjelly(light: Tensor) -> Callable[[], Tensor]:
    """SpikingJelly's integrate-and-fire neuron, all steps in one call, reset by subtraction."""
    with contextlib.redirect_stdout(io.StringIO()):
        from spikingjelly.activation_based import neuron, surrogate
    neurons = neuron.IFNode(
        v_threshold=1.0, v_reset=None, surrogate_function=surrogate.ATan(), detach_reset=True, step_mode="m"
    ).to(light.device)

    def run() -> Tensor:
        neurons.reset()
        return neurons(light)

    return run


def snntorch(light: Tensor) -> Callable[[], Tensor]:
    """SnnTorch's leaky neuron without a leak, step by step, reset by subtraction."""
    import snntorch

    neurons = snntorch.Leaky(beta=1.0, threshold=1.0, reset_mechanism="subtract").to(light.device)

    def run() -> Tensor:
        charge = torch.zeros_like(light[0])
        spikes = []
        for light_t in light:
            fired, charge = neurons(light_t, charge)
            spikes.append(fired)
        return torch.stack(spikes)

    return run


def _spikezoo() -> Any:
    with contextlib.redirect_stdout(io.StringIO()):
        from spikezoo.utils import spike_utils
    return spike_utils
