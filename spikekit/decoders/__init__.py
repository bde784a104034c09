"""Decoders: from spikes to light."""

from spikekit.decoders.chunked import decode_in_chunks
from spikekit.decoders.dense import SpikeInterval, Tfi, Tfp, spike_interval, tfi, tfp
from spikekit.decoders.packing import pack_spikes, unpack_spikes
from spikekit.decoders.single_frame import spike_interval_at, tfi_at, tfp_at

__all__ = [
    "SpikeInterval",
    "Tfi",
    "Tfp",
    "decode_in_chunks",
    "pack_spikes",
    "spike_interval",
    "spike_interval_at",
    "tfi",
    "tfi_at",
    "tfp",
    "tfp_at",
    "unpack_spikes",
]
