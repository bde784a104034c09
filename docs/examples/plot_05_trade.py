"""
Speed for accuracy: the trade curve
===================================

``lightning trade`` measures quality, time and memory of every setting. Its tables come with the weights; ``--speed``
and ``--budget`` read them. This script draws the table of x4 and chooses from it.
"""

import csv
from pathlib import Path

import matplotlib.pyplot as plt

import lightning_modules
from lightning_modules.inference.presets import Conditions, choose

with Path(lightning_modules.__file__).with_name("weights").joinpath("x4.csv").open(newline="") as file:
    rows = [row for row in csv.DictReader(file) if not row["failed"]]
for row in rows:
    row["ratio"], row["psnr"] = float(row["ratio"]), float(row["psnr"])

# %%
# No other setting beats those on the Pareto front in both time and PSNR. Time is given as a ratio to that of the first
# setting, as ratios carry over to other machines better than milliseconds do.

front = sorted((row for row in rows if row["front"] == "1"), key=lambda row: row["ratio"])
figure, ax = plt.subplots(figsize=(8, 4.6), layout="constrained")
ax.scatter([row["ratio"] for row in rows], [row["psnr"] for row in rows], color="0.7", label="measured")
ax.step([row["ratio"] for row in front], [row["psnr"] for row in front], "o-", where="post", label="Pareto front")
for row in front:
    where = {"xytext": (3, -4), "textcoords": "offset points", "rotation": -40, "rotation_mode": "anchor", "va": "top"}
    ax.annotate(row["setting"], (row["ratio"], row["psnr"]), fontsize=7, **where)
ax.set(xscale="log", xlim=(None, 60), xlabel="time, ratio", ylabel="PSNR (dB), x4")
ax.grid(alpha=0.3)
ax.legend()

# %%
# The choice of every speed at 250 x 400 sensor pixels:

conditions = Conditions(scale=4, size=(250, 400))
for speed in ("fastest", "fast", "balanced", "best"):
    print(f"{speed:9}{choose(conditions, speed)}")

# %%
# The best setting within 600 MB:

print(choose(conditions, budget="600MB"))
