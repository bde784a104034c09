"""A mosaic of numbers and its four sub-streams."""

import matplotlib.pyplot as plt
import torch

import spikekit as sk

COLOURS = {"R": "#f28e8c", "G1": "#8fd08f", "G2": "#b9e3a5", "B": "#8fb8ea"}
raw = torch.arange(16).reshape(4, 4)


def show(ax, numbers, names):
    """Draw the numbers in cells of their colours."""
    table = ax.table(
        [[str(int(number)) for number in row] for row in numbers],
        cellColours=[[COLOURS[name] for name in row] for row in names],
        cellLoc="center",
        bbox=(0, 0, 1, 1),
    )
    table.set_fontsize(12)
    ax.set_aspect(1)
    ax.axis("off")


figure = plt.figure(figsize=(7.2, 4.2), layout="constrained")
cells = figure.add_gridspec(2, 6, width_ratios=[1.9, 0.7, 1, 1, 1, 1])
for row, pattern in enumerate(("RGGB", "GBRG")):
    names = [["" for _ in range(4)] for _ in range(4)]
    for name, (_, y, x) in zip(COLOURS, sk.bayer_sites(pattern), strict=True):
        for i in range(16):
            if (i // 4 % 2, i % 2) == (y, x):
                names[i // 4][i % 4] = name
    ax = figure.add_subplot(cells[row, 0])
    show(ax, raw, names)
    ax.set_title(f'raw, "{pattern}"')
    arrow = figure.add_subplot(cells[row, 1])
    arrow.text(0.5, 0.5, "split\n$\\rightarrow$\n$\\leftarrow$\nmerge", ha="center", va="center")
    arrow.axis("off")
    for i, (name, plane) in enumerate(zip(COLOURS, sk.split_bayer(raw, pattern), strict=True)):
        ax = figure.add_subplot(cells[row, 2 + i])
        show(ax, plane, [[name] * 2] * 2)
        ax.set_title(name)
