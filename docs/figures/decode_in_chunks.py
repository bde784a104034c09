"""A stream in chunks: the spikes held for each piece of the result, and the agreement with the whole."""

import matplotlib.pyplot as plt
import torch

import spikekit as sk

window, overlap = 21, 10
light = 0.35 + 0.25 * torch.sin(torch.arange(160) / 12)
spikes = sk.simulate_spikes(light.reshape(-1, 1, 1), generator=torch.Generator().manual_seed(0))
chunks = spikes.split([40, 25, 60, 35])
held = []


def decode(part):
    """Decode ``part``, and record its length."""
    held.append(len(part))
    return sk.tfp(part, window)


pieces = list(sk.decode_in_chunks(decode, chunks, overlap))

figure, (spans, pixel) = plt.subplots(2, 1, figsize=(7.2, 3.6), sharex=True, layout="constrained", height_ratios=[2, 3])
begin = 0
for chunk in chunks:
    spans.barh("chunks", len(chunk), left=begin, color="0.8", edgecolor="white")
    begin += len(chunk)
begin = 0
pixel.plot(sk.tfp(spikes, window).flatten(), color="0.75", linewidth=6, label=f"tfp(spikes, {window})")
for number, (piece, length) in enumerate(zip(pieces, held, strict=True)):
    colour, first = f"C{number}", max(begin - overlap, 0)
    spans.barh(f"piece {number}", length, left=first, color=colour, alpha=0.3)
    spans.barh(f"piece {number}", len(piece), left=begin, color=colour)
    pixel.plot(range(begin, begin + len(piece)), piece.flatten(), color=colour, linewidth=1.5)
    begin += len(piece)
spans.invert_yaxis()
pixel.set(xlabel="clock", xlim=(0, len(spikes)))
pixel.legend()
