"""The sensor: from light to spikes, and the noise that a real one adds."""

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
