"""The picture and the film of the README: ``python docs/front_page.py`` writes docs/scenes.png and docs/film.gif.

Photographs outside the training set move in front of a simulated camera: x4, a picture every 20 clocks, alpha 0.4.
"""

from pathlib import Path

import torch
from skimage import data

import spikekit as sk
from lightning_modules.inference.film import film
from lightning_modules.networks import CSCSR, ClassicalDecoder

HERE, SCALE, ALPHA, WEIGHTS = Path(__file__).parent, 4, 0.4, "cscsr_huge_x4"


def recorded(photograph, height, width, frames, position, **motion):
    """Return a scene of a moving photograph, and its spikes."""
    rgb = torch.tensor(photograph).movedim(-1, 0) / 255
    moved = sk.Motion(center=(width / 2, height / 2), **motion)
    scene = sk.Scene([sk.Layer(rgb, moved, position=position)], height, width, frames=frames)
    light = scene.light("RGGB", scale=SCALE, alpha=ALPHA)
    return scene, sk.simulate_spikes(light, generator=torch.Generator().manual_seed(0))


def pictures(network, spikes):
    """Return the pictures of a film, reconstructed from spikes."""
    with torch.inference_mode():
        return list(film(network, [spikes], every=20, white=ALPHA))


def main():
    """Write the picture and the film."""
    ours = CSCSR.from_pretrained(WEIGHTS)
    tfi, tfp = (ClassicalDecoder(method, SCALE, "RGGB", ALPHA) for method in ("tfi", "tfp"))

    rows = []
    for photograph, position in (
        (data.coffee(), (-130, -40)),
        (data.chelsea(), (-100, -20)),
        (data.stereo_motorcycle()[0], (-150, -100)),
    ):
        scene, spikes = recorded(photograph, 240, 320, 101, position, velocity=(0.25, 0.1), rotation=3e-4)
        made = [pictures(network, spikes)[-1] for network in (tfi, tfp, ours)]
        truth = scene.rgb(made[-1].clock)
        print(*(f"{sk.psnr(rgb.clamp(0, 1), truth):.2f} dB" for _, rgb in made))
        rows.append([rgb.clamp(0, 1) for _, rgb in made] + [truth])
    sk.write_picture(HERE / "scenes.png", sk.panel(rows))

    _, spikes = recorded(data.coffee(), 192, 256, 281, (-170, -70), velocity=(0.22, 0.05), rotation=6e-4)
    both = [pictures(network, spikes) for network in (tfi, ours)]
    frames = [sk.panel([[rgb.clamp(0, 1) for _, rgb in pair]]) for pair in zip(*both, strict=True)]
    sk.write_video(HERE / "film.gif", frames, fps=8)


if __name__ == "__main__":
    main()
