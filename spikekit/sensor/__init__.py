"""The sensor: from light to spikes, with the noise of a real one."""

from spikekit.sensor.integrate_fire import SpikeIntegrateFire, spike_integrate_fire
from spikekit.sensor.noise import SensorNoise, SpikeChange
from spikekit.sensor.simulate import SpikeSensor, simulate_spikes

__all__ = [
    "SensorNoise",
    "SpikeChange",
    "SpikeIntegrateFire",
    "SpikeSensor",
    "simulate_spikes",
    "spike_integrate_fire",
]
