"""Two networks of clips of two lengths, and the motion that decides between them."""

import pytest
import torch

from lightning_modules.__main__ import main
from lightning_modules.inference.predict import predict
from lightning_modules.networks import CSCSR, TwoSpanCSCSR
from lightning_modules.storage.pretrained import Weights, settings_of, write_weights
from spikekit import write_spikes

TINY = {"width": 4, "representation_width": 4, "features": 1, "stages": 1, "blocks": 1, "end_blocks": 1}


@pytest.fixture(scope="module", name="files")
def _files(tmp_path_factory):
    folder, files = tmp_path_factory.mktemp("weights"), {}
    for name, clip in (("short", {"frames": 21, "stride": 1}), ("long", {"frames": 41, "stride": 3})):
        torch.manual_seed(len(name))
        network = CSCSR(2, **clip, **TINY)
        files[name] = str(folder / f"{name}.safetensors")
        write_weights(Weights(name, settings_of(network), {}, network.state_dict()), files[name])
    return files


@pytest.fixture(scope="module", name="network")
def _network(files):
    return TwoSpanCSCSR(2, 41, **files).eval()


def clip(height=40, width=48):
    return (torch.rand(1, 41, height, width, generator=torch.Generator().manual_seed(0)) < 0.3).float()


def uniform(pixels, height=40, width=48):
    """Flow of the longer clip whose ends are so many pixels away."""
    return torch.tensor([-pixels, pixels]).reshape(1, 2, 1, 1, 1).expand(1, 2, 2, height, width) / 2**0.5


@torch.no_grad()
def test_the_speed_chooses(network):
    spikes, middle = clip(), clip()[:, 10:31]
    slow, fast = uniform(0.5), uniform(3.0)  # in 15 clocks: 0.5 is slow below 0.5, 3 fast above 1.33
    torch.testing.assert_close(network(spikes, slow), network.long(spikes, slow), rtol=0, atol=0)
    torch.testing.assert_close(network(spikes, fast), network.short(middle, fast / 3), rtol=0, atol=0)
    torch.testing.assert_close(network(spikes, static=True), network.long(spikes, static=True), rtol=0, atol=0)
    between = uniform(11 / 12)  # half way from 1/2 to 4/3
    expected = (network.long(spikes, between) + network.short(middle, between / 3)) / 2
    torch.testing.assert_close(network(spikes, between), expected, rtol=0, atol=1e-5)


@torch.no_grad()
def test_each_place_is_seen_by_the_network_of_its_speed(network):
    spikes, flow = clip(), uniform(0.2).clone()
    flow[..., 24:] = uniform(4.0)[..., 24:]
    share = network.share_of_long(flow)
    assert share[..., :10].min() == 1
    assert share[..., 36:].max() == 0
    assert ((share > 0) & (share < 1)).any()
    rgb, few = network(spikes, flow), flow / 3
    torch.testing.assert_close(rgb[..., :20], network.long(spikes, flow)[..., :20], rtol=0, atol=0)
    torch.testing.assert_close(rgb[..., 72:], network.short(spikes[:, 10:31], few)[..., 72:], rtol=0, atol=0)
    both = torch.stack([few, flow], dim=1)
    torch.testing.assert_close(network(spikes, both), rgb, rtol=0, atol=0)
    torch.testing.assert_close(predict(network, spikes, both, tile=16), rgb.clamp(0, 1), rtol=0, atol=1e-5)


def test_flows_are_those_of_both_clips(network):
    spikes = clip()
    few, many = network.estimate_flow(spikes).unbind(1)
    torch.testing.assert_close(few, network.short.estimate_flow(spikes[:, 10:31]))
    torch.testing.assert_close(many, network.long.estimate_flow(spikes))
    assert not any(parameter.requires_grad for parameter in network.parameters())


def test_errors(files):
    with pytest.raises(ValueError, match=r"scale: expected 2, that of .*short.safetensors, got 4"):
        TwoSpanCSCSR(4, 41, **files)
    with pytest.raises(
        ValueError, match=r"frames: expected 41, those of .*long.* more than the 21 of .*short.*, got 101"
    ):
        TwoSpanCSCSR(2, 101, **files)
    with pytest.raises(ValueError, match=r"frames: expected 21, .* more than the 41 of"):
        TwoSpanCSCSR(2, 41, short=files["long"], long=files["short"])


@pytest.mark.parametrize(("speed", "said"), [(0.0, "100%"), (9.0, "0%")])
def test_predict_says_which_clips_the_pictures_are_of(files, tmp_path, monkeypatch, capsys, speed, said):
    monkeypatch.setattr(TwoSpanCSCSR, "estimate_flow", lambda _, spikes: uniform(speed, *spikes.shape[-2:]))
    write_spikes(tmp_path / "clip.npz", clip()[0].to(torch.uint8))
    network = ["--model.network", "TwoSpanCSCSR", "--model.network.scale", "2", "--model.network.frames", "41"]
    network += [f"--model.network.{name}={file}" for name, file in files.items()]
    data = ["--data", "Recording", "--data.path", str(tmp_path / "clip.npz"), "--data.white", "0.3"]
    main(["predict", *network, *data, "--trainer.accelerator", "cpu", "-o", str(tmp_path / "out")])
    expected = f"{said} of the pictures are of clips of 41 frames, the faster rest of 21\n"
    assert expected in capsys.readouterr().out
