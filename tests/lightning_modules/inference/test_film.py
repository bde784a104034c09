import gc
import math
import os
import resource

import pytest
import torch

from lightning_modules import reconstruct
from lightning_modules.inference.film import FilmMaker, film
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
    how = {"white": 0.25, "interpolated": int(network.takes_flow)}
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


@pytest.mark.parametrize("tile", [0, 8])
@pytest.mark.parametrize("interpolated", [1, 3])
def test_interpolated_pictures_match_the_scene_up_to_the_edges(interpolated, tile):
    network = Truth()
    maker = FilmMaker(network, 0, interpolated, tile=tile)
    network.frames = 40  # only says how far a picture may be away
    group, found = interpolated + 1, []
    clocks = [10 + 4 * n for n in range(2 * group)]
    for first in (0, group):
        part = clocks[first : first + group]
        found.append(maker(clips(part), part))
    expected = torch.stack([waves(clock) for clock in clocks])
    assert error(torch.cat(found), expected) < 0.01
    assert error(waves(clocks[0]), waves(clocks[1])) > 0.05
    if not tile:
        assert network.asked == [clocks[n] for n in (0, group - 1, 2 * group - 1)]


def test_tiles_do_not_change_interpolation():
    torch.manual_seed(0)
    network = CSCSR(**TINY).eval()
    spikes = (torch.rand(4, 41, 40, 36) < 0.3).to(torch.uint8)
    network.halo = 40
    whole, tiled = (FilmMaker(network, 0, 3, tile=tile)(spikes, [20, 26, 32, 38]) for tile in (0, 16))
    torch.testing.assert_close(tiled, whole, rtol=0, atol=2e-4)


def test_static_pictures_are_blended():
    network = CSCSR(**TINY).eval()
    spikes = (torch.rand(4, 41, 12, 10) < 0.3).to(torch.uint8)
    found = FilmMaker(network, 0, 2)(spikes, [20, 40, 50, 60], static=True)
    first, last = network(spikes[[0, 2]], static=True).clamp(0, 1)
    torch.testing.assert_close(found[[0, 2]], torch.stack([first, last]))
    torch.testing.assert_close(found[1], first / 3 + last * 2 / 3)


def test_network_runs_only_on_its_own_pictures():
    network = Truth()
    maker = FilmMaker(network, 0, 1)
    maker(clips([0, 3]), [0, 3])
    maker(clips([6, 9, 12]), [6, 9, 12])  # 6 lies between 3 and 9; a group ends with a picture of the network
    assert network.asked == [0, 3, 9, 12]
    maker(clips([40, 43]), [40, 43])  # too far away from 12
    assert network.asked[4:] == [40, 43]


def test_exposure_of_every_clip():
    exposure = torch.tensor([0.5, 0.25, 1.0]).reshape(3, 1, 1, 1)
    found = FilmMaker(Truth(), 0, 2)(clips([0, 1, 2]), [0, 1, 2], exposure=exposure)
    torch.testing.assert_close(found[0], 0.5 * waves(0))
    torch.testing.assert_close(found[2], waves(2))


def test_interpolation_blends_light_and_motion(monkeypatch):
    network, x = Truth(), torch.arange(2.0 * SIDE).expand(1, 3, 2 * SIDE, -1) / 1000
    monkeypatch.setattr(network, "forward", lambda spikes, *_: x * (1 + clock(spikes) / 4))
    ends = torch.tensor([-2.0, 2.0]).reshape(1, 2, 1, 1, 1).expand(1, 2, 2, SIDE, SIDE)
    monkeypatch.setattr(network, "estimate_flow", lambda spikes: clock(spikes)[None] / 8 * ends)
    maker = FilmMaker(network, 0, 3)
    maker(clips([0]), [0])
    found = maker(clips([1, 2, 3, 4]), [1, 2, 3, 4])
    share, moved = 1 / 4, SCALE * (0.5 * 1 / 4) / 1000  # 0.5 sensor pixels a clock at 4, none at 0
    expected = (1 - share) * (x - moved) + share * 2 * (x + 3 * moved)
    torch.testing.assert_close(found[:1, :, 8:-8, 8:-8], expected[:, :, 8:-8, 8:-8])


def test_state_advances_between_pictures_of_the_network():
    torch.manual_seed(1)
    network = RecurrentCSCSR(**TINY).eval()
    torch.nn.init.normal_(network.fusion.share.weight, std=0.1)
    spikes = (torch.rand(8, 41, 12, 10) < 0.3).to(torch.uint8)
    clocks = [20 + 5 * n for n in range(8)]
    maker, keys = FilmMaker(network, 0, 1), FilmMaker(network)
    found = torch.cat([maker(spikes[n : n + 2], clocks[n : n + 2]) for n in range(0, 8, 2)])
    seen = [0, 1, 3, 5, 7]
    expected = torch.cat([keys(spikes[n : n + 1], clocks[n : n + 1]) for n in seen])
    torch.testing.assert_close(found[seen], expected)
    groups = FilmMaker(network, 0, 1)
    both = torch.cat([groups(spikes[n : n + 4], clocks[n : n + 4]) for n in (0, 4)])
    assert (both[1] - found[1]).abs().max() > 1e-3  # has seen 3
    torch.testing.assert_close(both[0], found[0])


def test_interpolated_pictures_wait_for_the_next_picture_of_the_network():
    network, come = Truth(), []

    def camera():
        for clock in range(60):
            come.append(clock)
            yield torch.full((1, SIDE, SIDE), float(clock))

    shown = []
    for clock, rgb in film(network, camera(), 2, interpolated=1, white=1.0):
        shown.append((clock, come[-1]))
        assert error(rgb, waves(clock - 2)) < 0.01  # Truth reads the clock of a clip's first frame
    assert shown[:4] == [(2, 4), (4, 8), (6, 8), (8, 12)]


def test_self_ensemble_carries_no_state():
    network = RecurrentCSCSR(**TINY).eval()
    spikes = (torch.rand(2, 41, 12, 10) < 0.3).to(torch.uint8)
    alone = [predict(network, clip, self_ensemble=2) for clip in spikes.split(1)]
    torch.testing.assert_close(FilmMaker(network, self_ensemble=2)(spikes, [20, 40]), torch.cat(alone))


def test_unsupported_film_options_are_rejected():
    network = CSCSR(**TINY)
    for wrong in (-1, 0.5, True):
        with pytest.raises((ValueError, TypeError), match="interpolated"):
            FilmMaker(network, 0, wrong)
    with pytest.raises(ValueError, match="interpolated: expected 0, as ClassicalDecoder estimates no motion"):
        FilmMaker(ClassicalDecoder(), 0, 1)
    with pytest.raises(ValueError, match="future: expected 0, as CSCSR takes single clips, got 1"):
        FilmMaker(network, 1)
    with pytest.raises(ValueError, match=r"clocks: expected 2 increasing ones, got \[3, 3\]"):
        FilmMaker(network)(torch.zeros(2, 41, 12, 10), [3, 3])
