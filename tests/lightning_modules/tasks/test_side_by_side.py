"""Pictures made in several threads of one process, and by several."""

from concurrent.futures import ThreadPoolExecutor

import torch

from lightning_modules.inference.predict import predict
from lightning_modules.inference.presets import choose


def test_pictures_made_in_and_by_several_threads_are_those_of_one():
    network = choose(4, "fast").preset.build()
    generator = torch.Generator().manual_seed(0)
    clips = [
        (torch.rand(1, 41, 24 + 2 * n, 40, generator=generator) < 0.1 * (1 + n % 5)).to(torch.uint8) for n in range(4)
    ]

    def picture(spikes):
        with torch.no_grad():  # a setting of each thread
            return predict(network, spikes)

    expected = list(map(picture, clips))
    before = torch.get_num_threads()
    try:
        for count in (1, 2):  # what a matrix product adds up in another order
            torch.set_num_threads(count)
            torch.testing.assert_close(picture(clips[0]), expected[0], rtol=0, atol=1e-5)
    finally:
        torch.set_num_threads(before)
    with ThreadPoolExecutor(4) as pool:
        for _ in range(2):
            for found, alone in zip(pool.map(picture, clips), expected, strict=True):
                torch.testing.assert_close(found, alone, rtol=0, atol=1e-5)
