import gc
import os
import resource

import pytest
import torch

from lightning_modules.data.clips_around import clips_around
from lightning_modules.inference.film import film
from lightning_modules.inference.predict import predict
from lightning_modules.motion import ClassicalFlow
from lightning_modules.networks import CSCSR, ClassicalDecoder


@pytest.fixture(name="spikes", scope="module")
def _spikes():
    torch.manual_seed(0)
    return (torch.rand(113, 8, 10) < torch.linspace(0.02, 0.4, 10)).to(torch.uint8)


@pytest.mark.parametrize("chunk", [1, 7, 50, 113])
@pytest.mark.parametrize("every", [3, 20, 45])
def test_pictures_are_those_of_single_clips_however_the_stream_is_cut(spikes, chunk, every):
    network = ClassicalDecoder("tfp", scale=2)
    found = dict(film(network, spikes.split(chunk), every, white=0.3))
    assert list(found) == list(range(20, 93, every))
    for clock, rgb in found.items():
        clip = spikes[None, clock - 20 : clock + 21]
        assert rgb.equal(predict(network, clip, exposure=0.4 / 0.3)[0])


def test_a_picture_is_twenty_clocks_late(spikes):
    come = 0

    def camera():
        nonlocal come
        for chunk in spikes.split(1):
            come += 1
            yield chunk

    for clock, _ in film(ClassicalDecoder(scale=1), camera(), 10):
        assert come == clock + 20 + 1  # clock 0 is the first that comes


def test_white_is_that_of_the_first_clip_in_all_pictures(spikes):
    bright = torch.cat([spikes, torch.ones(50, 8, 10, dtype=torch.uint8)])
    given, found = (
        [rgb for _, rgb in film(ClassicalDecoder("tfp", scale=1), bright.split(9), white=white)]
        for white in (torch.quantile(spikes[:41].float().mean(0), 0.999).item(), None)
    )
    assert all(map(torch.allclose, given, found))


def test_what_lies_between_clips_is_left_out_where_a_stream_can(spikes):
    read = []

    def jump(start):
        for n in range(start, len(spikes)):
            read.append(n)
            yield spikes[n]

    found = dict(clips_around([6, 8, 100], 5, jump(4), 4, jump))
    assert read == [*range(4, 11), *range(98, 103)]
    assert all(clip.equal(spikes[middle - 2 : middle + 3]) for middle, clip in found.items())
    assert list(found) == [6, 8, 100]


def test_errors(spikes):
    network = ClassicalDecoder()
    with pytest.raises(ValueError, match="every: expected a whole number >= 1, got 0"):
        film(network, [spikes], 0)
    with pytest.raises(ValueError, match="white"):
        film(network, [spikes], white=0)
    with pytest.raises(ValueError, match=r"chunks: expected \(T, H, W\), got \(1, 113, 8, 10\)"):
        next(film(network, [spikes[None]]))


def test_memory_stays_flat_over_a_long_film():
    """SPIKEKIT_FUZZ=N in the environment makes N pictures."""
    count = int(os.environ.get("SPIKEKIT_FUZZ", "40"))
    sizes = {"width": 4, "representation_width": 4, "features": 1, "stages": 1, "end_blocks": 1}
    network = CSCSR(scale=2, motion=ClassicalFlow(), **sizes).eval()
    generator = torch.Generator().manual_seed(0)
    stream = ((torch.rand(3, 24, 32, generator=generator) < 0.3).to(torch.uint8) for _ in range(count + 32))

    def held():
        gc.collect()
        tensors = sum(issubclass(type(one), torch.Tensor) for one in gc.get_objects())
        return tensors, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10

    with torch.no_grad():
        pictures = film(network, stream, every=3)
        for _ in range(10):
            next(pictures)
        tensors, most = held()
        for _ in range(count):
            next(pictures)
        now, peak = held()
    assert now <= tensors
    assert peak - most < 16 << 20
