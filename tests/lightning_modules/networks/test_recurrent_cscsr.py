import pytest
import torch

from lightning_modules.inference.film import FilmMaker, film
from lightning_modules.networks import CSCSR, ClassicalDecoder, RecurrentCSCSR
from spikekit import flow_warp

TINY = {"scale": 2, "width": 8, "representation_width": 8, "features": 1, "stages": 1, "end_blocks": 1, "skip": True}
CLOCKS = [20, 40, 60, 80, 100]


@pytest.fixture(name="network")
def _network():
    """A network with random instead of zero weights, so that neighbours matter."""
    torch.manual_seed(0)
    network = RecurrentCSCSR(**TINY).eval()
    torch.nn.init.normal_(network.fusion.share.weight, std=0.05)
    torch.nn.init.normal_(network.fusion.rest.weight, std=0.02)
    torch.nn.init.normal_(network.reconstruction.rgb.weight, std=0.05)
    return network


@pytest.fixture(name="clips")
def _clips():
    """Five clips (5, 41, H, W), 20 clocks apart, and their flows."""
    generator = torch.Generator().manual_seed(1)
    stream = torch.rand(121, 22, 26, generator=generator) < 0.3
    flow = torch.randn(5, 2, 2, 1, 1, generator=generator).expand(-1, -1, -1, 22, 26)
    return torch.stack([stream[clock - 20 : clock + 21] for clock in CLOCKS]), flow


def test_untrained_fusion_gives_the_pictures_of_the_clip_network(clips):
    single = CSCSR(**TINY, resolution="sensor").eval()
    network = RecurrentCSCSR(**single.settings).eval()
    assert all(name.startswith("fusion.") for name in network.load_state_dict(single.state_dict(), strict=False)[0])
    torch.nn.init.normal_(single.reconstruction.rgb.weight, std=0.05)
    network.reconstruction.load_state_dict(single.reconstruction.state_dict())
    spikes, flow = clips
    torch.testing.assert_close(network(spikes[:1], flow[:1]), single(spikes[:1], flow[:1]))
    pictures = network(spikes[None], flow[None], future=4)[0]
    torch.testing.assert_close(pictures, single(spikes, flow))


def test_only_the_first_key_frame_equals_that_of_a_single_clip(network, clips):
    spikes, flow = clips
    pictures, single = network(spikes[None], flow[None])[0], network(spikes, flow)
    torch.testing.assert_close(pictures[0], single[0])
    assert ((pictures[1:] - single[1:]).abs().amax(dim=(1, 2, 3)) > 1e-3).all()


@pytest.mark.parametrize("future", [0, 1, 4])
def test_picture_depends_on_all_earlier_key_frames_and_on_its_group(network, clips, future):
    spikes, flow = clips
    known = spikes[None].float().requires_grad_()
    rgb = network(known, flow[None], future=future)
    for n, picture in enumerate(rgb[0]):
        seen = torch.autograd.grad(picture.sum(), known, retain_graph=True)[0][0].abs().amax(dim=(1, 2, 3)) > 0
        last = min((n // (future + 1) + 1) * (future + 1), 5)
        assert seen.tolist() == [m < last for m in range(5)]


def test_backward_pass_is_the_forward_pass_of_the_reversed_film(network, clips):
    spikes, flow = clips
    earlier, final = network.film(spikes[None], flow[None], future=4)
    torch.testing.assert_close(earlier[0, 4], network(spikes[4:], flow[4:])[0])
    assert (final[0, 4] - earlier[0, 4]).abs().max() > 1e-3
    # at rest, the backward pass equals the forward pass of the reversed film
    turned = network(spikes.flip(0)[None], static=True)
    torch.testing.assert_close(network.film(spikes[None], static=True, future=4)[0].flip(1), turned)


@pytest.mark.parametrize(("future", "tile"), [(0, 16), (1, 0), (4, 16)])
def test_groups_and_tiles_give_the_pictures_of_the_whole_film(network, clips, future, tile):
    spikes, _ = clips
    maker = FilmMaker(network, future, tile=tile)
    found = [maker(spikes[n : n + future + 1], CLOCKS[n : n + future + 1]) for n in range(0, 5, future + 1)]
    flow = torch.cat([network.estimate_flow(clip) for clip in spikes.split(1)])
    expected = network(spikes[None], flow[None], future=future)[0].clamp(0, 1)
    torch.testing.assert_close(torch.cat(found), expected, rtol=0, atol=2e-3 if tile else 1e-4)


def test_state_is_warped_with_the_scene(network):
    network = RecurrentCSCSR(**{**TINY, "scale": 4})
    state = torch.rand(1, 48 + 32, 10, 12)
    flow = torch.zeros(1, 2, 10, 12)
    torch.testing.assert_close(network.moved(state, flow), state)
    flow[:, 0], flow[:, 1] = 0.75, -0.5  # three and two output pixels
    moved = network.moved(state, flow)
    torch.testing.assert_close(moved[:, 48:], flow_warp(state[:, 48:], flow))
    inside = network.picture(moved)[..., 8:-8, 8:-8]
    torch.testing.assert_close(inside, network.picture(state)[..., 6:-10, 11:-5])


def test_distant_key_frames_are_not_neighbours(network, clips):
    spikes, _ = clips
    maker, single = FilmMaker(network), FilmMaker(network)(spikes[1:2], [61])
    maker(spikes[:1], [20])
    assert (maker(spikes[1:2], [61]) - single).abs().max() > 1e-3
    torch.testing.assert_close(maker(spikes[1:2], [61 + 42]), single)


@pytest.mark.parametrize("future", [0, 3])
def test_film_of_a_stream(network, clips, future):
    torch.manual_seed(3)
    stream = (torch.rand(113, 12, 14) < 0.3).to(torch.uint8)
    shown = list(film(network, stream.split(7), 20, white=0.4, future=future, static=True))
    clocks = [20, 40, 60, 80]
    assert [frame.clock for frame in shown] == clocks
    spikes = torch.stack([stream[clock - 20 : clock + 21] for clock in clocks])
    expected = network(spikes[None], static=True, future=future)[0].clamp(0, 1)
    torch.testing.assert_close(torch.stack([frame.rgb for frame in shown]), expected)


def test_picture_is_returned_once_its_group_is_complete(network):
    come = []

    def camera():
        for n in range(200):
            come.append(n)
            yield torch.zeros(1, 8, 8)

    for clock, _ in film(network, camera(), 20, future=2, static=True, white=0.4):
        last = 20 + (clock // 20 - 1) // 3 * 60 + 40
        assert come[-1] == last + 20
        if clock == 120:
            break


def test_invalid_settings_are_rejected(network, clips):
    with pytest.raises(ValueError, match=r"resolution: expected correlated and sensor .* got correlated and output"):
        RecurrentCSCSR(resolution="output")
    with pytest.raises(ValueError, match=r"correlated and sensor.* got early"):
        RecurrentCSCSR(reconstruction="early")
    spikes, _ = clips
    with pytest.raises(ValueError, match=r"clocks: expected 2 increasing ones, got \[40, 20\]"):
        FilmMaker(network)(spikes[:2], [40, 20])
    with pytest.raises(ValueError, match="future: expected 0, as ClassicalDecoder takes single clips, got 1"):
        film(ClassicalDecoder(), [], future=1)
