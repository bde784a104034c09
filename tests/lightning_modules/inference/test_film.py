import gc
import math
import os
import resource

import pytest
import torch

from lightning_modules import reconstruct
from lightning_modules.inference.film import FilmMaker, _Made, film
from lightning_modules.inference.predict import predict
from lightning_modules.motion import ClassicalFlow
from lightning_modules.networks import CSCSR, ClassicalDecoder, Network, RecurrentCSCSR
from spikekit import write_spikes

SCALE, SIDE = 2, 24
SPEED = (0.25, -0.125)  # pixels of the picture in a clock
TINY = {"scale": 2, "width": 8, "representation_width": 8, "features": 1, "stages": 1, "end_blocks": 1}


@pytest.fixture(name="spikes", scope="module")
def _spikes():
    torch.manual_seed(0)
    return (torch.rand(113, 8, 10) < torch.linspace(0.02, 0.4, 10)).to(torch.uint8)


@pytest.mark.parametrize("chunk", [1, 7, 50, 113])
@pytest.mark.parametrize("every", [3, 20, 45])
def test_pictures_do_not_depend_on_chunks(spikes, chunk, every):
    network = ClassicalDecoder("tfp", scale=2)
    found = dict(film(network, spikes.split(chunk), every, white=0.5))
    assert list(found) == list(range(20, 93, every))
    for clock, rgb in found.items():
        clip = spikes[None, clock - 20 : clock + 21]
        assert rgb.equal(predict(network, clip, exposure=0.8)[0])


def test_picture_comes_after_twenty_clocks(spikes):
    come = 0

    def camera():
        nonlocal come
        for chunk in spikes.split(1):
            come += 1
            yield chunk

    for clock, _ in film(ClassicalDecoder(scale=1), camera(), 10):
        assert come == clock + 20 + 1  # clock 0 is the first that comes


def test_white_level_of_the_first_clip_is_used_for_all_pictures(spikes):
    bright = torch.cat([spikes[..., :5], torch.ones(50, 8, 5, dtype=torch.uint8)])  # the first clip has 82 frames
    given, found = (
        [rgb for _, rgb in film(ClassicalDecoder("tfp", scale=1), bright.split(9), white=white)]
        for white in (torch.quantile(bright[:82].float().mean(0), 0.999).item(), None)
    )
    assert all(map(torch.allclose, given, found))


@pytest.mark.parametrize("network", [ClassicalDecoder("tfp"), CSCSR(**TINY).eval()])
def test_dim_films_have_the_pictures_of_dim_recordings(tmp_path, network):
    spikes, path = torch.rand(200, 8, 8) < 0.1, tmp_path / "dim.npz"
    write_spikes(path, spikes)
    how = {"white": 0.25, "psnr_tolerance": 0.1}
    pictures = dict(reconstruct(path, network=network, frame="41:159", precision="32-true", **how))
    torch.testing.assert_close(dict(film(network, spikes.split(9), **how)), pictures)


def test_invalid_arguments_are_rejected(spikes):
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


class Truth(Network):
    """Shows waves that move evenly, as they are at the clock which all spikes of a clip are said to be."""

    halo = None  # not seen tile by tile: it makes the whole picture

    def __init__(self):
        super().__init__({"scale": SCALE, "frames": 5, "pattern": "RGGB", "alpha": 1.0}, (0, 2, 4))
        self.asked = []

    def estimate_flow(self, spikes):
        way = torch.tensor(SPEED).reshape(2, 1, 1).expand(2, *spikes.shape[-2:]) / SCALE
        return torch.stack([-2 * way, 2 * way])[None].expand(len(spikes), -1, -1, -1, -1)

    def forward(self, spikes, flow=None, static=False):
        clocks = spikes[:, 0, 0, 0].tolist()
        self.asked += clocks
        return torch.stack([waves(clock, *spikes.shape[-2:]) for clock in clocks])


def waves(clock, height=SIDE, width=SIDE):
    y, x = torch.meshgrid(torch.arange(SCALE * height), torch.arange(SCALE * width), indexing="ij")
    x, y = x - SPEED[0] * clock, y - SPEED[1] * clock
    return torch.stack(
        [0.5 + 0.4 * torch.sin(2 * math.pi * (x / a + y / b)) for a, b in ((30, 40), (50, 30), (40, 40))]
    )


def clock(spikes):
    return spikes[:, 0, 0, 0].reshape(-1, 1, 1, 1)


def error(found, expected):
    """But for two corners, which come from outside of both neighbours."""
    apart = (found - expected).abs()
    apart[..., :6, :6] = apart[..., -6:, -6:] = 0
    return apart.max()


def clips(clocks, side=SIDE):
    return torch.stack([torch.full((5, side, side), float(clock)) for clock in clocks])


def between(network, clock, *ends, tile=None):
    seen = (clips([end]) for end in ends)
    made = [_Made(end, network(clip), network.estimate_flow(clip), None) for end, clip in zip(ends, seen, strict=True)]
    return FilmMaker(network, tile=tile)._interpolate(*made, clock)


@pytest.mark.parametrize("tile", [0, 8])
@pytest.mark.parametrize("clock", [14, 16, 22])
def test_interpolated_pictures_match_the_scene_up_to_the_edges(clock, tile):
    assert error(between(Truth(), clock, 10, 26, tile=tile)[0], waves(clock)) < 0.002
    assert error(waves(10), waves(14)) > 0.05


def test_interpolation_blends_light_and_motion(monkeypatch):
    network, x = Truth(), torch.arange(2.0 * SIDE).expand(1, 3, 2 * SIDE, -1) / 1000
    monkeypatch.setattr(network, "forward", lambda spikes, *_: x * (1 + clock(spikes) / 4))
    ends = torch.tensor([-2.0, 2.0]).reshape(1, 2, 1, 1, 1).expand(1, 2, 2, SIDE, SIDE)
    monkeypatch.setattr(network, "estimate_flow", lambda spikes: clock(spikes)[None] / 8 * ends)
    share, moved = 1 / 4, SCALE * (0.5 * 1 / 4) / 1000  # 0.5 sensor pixels a clock at 4, none at 0
    expected = (1 - share) * (x - moved) + share * 2 * (x + 3 * moved)
    torch.testing.assert_close(between(network, 1, 0, 4)[..., 8:-8, 8:-8], expected[..., 8:-8, 8:-8])


def test_exposure_of_every_clip():
    exposure = torch.tensor([0.5, 0.25, 1.0]).reshape(3, 1, 1, 1)
    found = FilmMaker(Truth())(clips([0, 1, 2]), [0, 1, 2], exposure=exposure)
    torch.testing.assert_close(found, exposure * torch.stack([waves(0), waves(1), waves(2)]))


def test_self_ensemble_carries_no_state():
    network = RecurrentCSCSR(**TINY).eval()
    spikes = (torch.rand(2, 41, 12, 10) < 0.3).to(torch.uint8)
    alone = [predict(network, clip, self_ensemble=2) for clip in spikes.split(1)]
    torch.testing.assert_close(FilmMaker(network, self_ensemble=2)(spikes, [20, 40]), torch.cat(alone))


def test_unsupported_film_options_are_rejected():
    network = CSCSR(**TINY)
    for wrong in (-1, 0.5, True):
        with pytest.raises((ValueError, TypeError), match="future"):
            FilmMaker(network, wrong)
    with pytest.raises(ValueError, match="future: expected 0, as CSCSR takes single clips, got 1"):
        FilmMaker(network, 1)
    with pytest.raises(ValueError, match=r"clocks: expected 2 increasing ones, got \[3, 3\]"):
        FilmMaker(network)(torch.zeros(2, 41, 12, 10), [3, 3])
