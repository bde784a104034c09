"""``lightning trade`` and its parts."""

import csv
import random
import re
from pathlib import Path

import pytest
import pytorch_lightning
import torch
from pytorch_lightning import LightningDataModule

from lightning_modules.__main__ import main
from lightning_modules.cli.errors import UsageError
from lightning_modules.data import FilmScenes
from lightning_modules.inference import presets
from lightning_modules.inference.presets import Preset
from lightning_modules.metrics.flicker import film_flicker
from lightning_modules.motion import Spike2Flow
from lightning_modules.networks import CSCSR, TSCNN
from lightning_modules.storage.pretrained import settings_of
from lightning_modules.trade import cli
from lightning_modules.trade.films import film_scenes
from lightning_modules.trade.measure import Measurement, Timed, time_in_turns
from lightning_modules.trade.runner import CannotRunError, Runner, make_runner
from lightning_modules.trade.settings import Setting, read_setting, usual_settings
from lightning_modules.trade.table import figures, front, write_csv
from spikekit import flow_warp, psnr

CONFIGS = Path(__file__).parents[3] / "configs"
WIDTHS = dict.fromkeys(("width", "representation_width", "features", "stages", "blocks", "end_blocks"), 2)
TINY = f"""
model: {{network: {{init_args: {WIDTHS}}}}}
data: {{init_args: {{patch: 8, val_patch: 12, train_clips: 8, val_clips: 3, batch_size: 2, workers: 0}}}}
"""
TFI = "--model.network ClassicalDecoder --model.network.method tfi"


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """Arguments of all settings."""
    tiny = tmp_path_factory.mktemp("overlay") / "tiny.yaml"
    tiny.write_text(TINY)
    return ["-c", str(CONFIGS / "x4.yaml"), "-c", str(tiny), "--trainer.precision", "32-true"]


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """As ``lightning fit`` leaves it, of a network that the seed of the configuration would not make."""
    torch.manual_seed(5)
    network = CSCSR(**WIDTHS)
    path = tmp_path_factory.mktemp("checkpoint") / "best.ckpt"
    weights = {f"network.{name}": value for name, value in network.state_dict().items()}
    version = {"pytorch-lightning_version": pytorch_lightning.__version__}
    torch.save({"network": settings_of(network), "state_dict": weights, **version}, path)
    return path


@pytest.fixture(scope="module")
def base(shared):
    return Runner(shared)


def rows_of(output):
    return {row["setting"]: row for row in csv.DictReader((output / "trade.csv").open())}


@pytest.fixture(scope="module")
def traded(shared, checkpoint, tmp_path_factory):
    output = tmp_path_factory.mktemp("trade") / "out"
    settings = [
        "as it is:",
        f"trained: --ckpt_path {checkpoint}",
        "--model.network.motion ZeroFlow",
        "small tiles: --tile 4",
        f"TFI: {TFI}",
        "missing: --model.weights nowhere.safetensors",
    ]
    words = [word for setting in settings for word in ("--setting", setting)]
    main(["trade", *shared, *words, "--rounds", "2", "-o", str(output)])
    return output


@pytest.mark.slow
def test_every_setting_has_a_row_in_both_files(traded):
    rows = rows_of(traded)
    names = ["as it is", "trained", "--model.network.motion ZeroFlow", "small tiles", "TFI", "missing"]
    assert list(rows) == names
    text = (traded / "trade.md").read_text()
    for name, row in rows.items():
        assert f" {name} " in text
        if name == "missing":
            assert (row["psnr"], row["ms"]) == ("", "")
            assert "nowhere.safetensors: no such file of weights" in row["failed"]
            assert f"missing cannot run: {row['failed']}" in text
            continue
        assert row["failed"] == ""
        assert re.search(rf"\| {float(row['psnr']):.2f} +\| {float(row['ssim']):.4f} +\|", text)
        assert 0 < float(row["ms_q1"]) <= float(row["ms"]) <= float(row["ms_q3"])
    threads = f"{torch.get_num_threads()} thread"
    for said in ("mean of 3 clips", "2 clips of 12 x 12", "2 rounds", threads, torch.__version__):
        assert said in text
    assert float(rows["as it is"]["ratio"]) == 1
    tiles = rows["small tiles"]
    assert (tiles["tile"], tiles["height"], tiles["width"]) == ("4", "12", "12")
    assert {row["reference"] for row in rows.values()} == {"as it is"}
    assert {name for name, row in rows.items() if any(row[key] for key in vars(Preset()))} == set(names[3:])


@pytest.mark.slow
def test_scores_are_those_of_lightning_test(traded, shared, checkpoint, tmp_path):
    rows = rows_of(traded)
    words = ["--ckpt_path", str(checkpoint), "-o", str(tmp_path), "--trainer.enable_progress_bar=false"]
    main(["test", *shared, *words])
    means = {row["method"]: row for row in csv.DictReader((tmp_path / "test.csv").open()) if row["clip"] == "mean"}
    for ours, theirs in (("trained", "CSCSR"), ("TFI", "TFI")):
        for score in ("psnr", "ssim"):
            assert float(rows[ours][score]) == pytest.approx(float(means[theirs][score]), abs=1e-4)
    assert len({rows[name]["psnr"] for name in ("as it is", "trained", "TFI")}) == 3


@pytest.mark.slow
def test_films_of_single_clip_networks(shared, base, tmp_path):
    """Pictures, errors and work equal those of single clips."""
    settings = ["--setting", "as it is:", "--setting", f"TFI: {TFI}"]
    more = ["--data.val_clips", "1", "--rounds", "1", "--film", "10"]
    main(["trade", *shared, *settings, *more, "-o", str(tmp_path)])
    rows, text = rows_of(tmp_path), (tmp_path / "trade.md").read_text()
    assert "5 pictures each, 10 clocks apart" in text
    assert [(row["latency"], row["every"], row["failed"]) for row in rows.values()] == [("20", "10", "")] * 2
    scene = next(film_scenes(base.data, 41, 10))
    clips = scene["spikes"][0].unfold(0, 41, 10).movedim(-1, 1)[1:4]
    rgb = torch.cat([base(clip[None]) for clip in clips])
    assert float(rows["as it is"]["psnr"]) == pytest.approx(psnr(rgb, scene["rgb"]).mean().item(), abs=1e-4)
    truth, flow = scene["rgb"], scene["flow"]
    pairs = [film_flicker(*(part[None] for part in (rgb[1], rgb[n], truth[1], truth[n], flow[n // 2]))) for n in (0, 2)]
    assert float(rows["as it is"]["flicker"]) == pytest.approx(torch.cat(pairs).mean().item(), abs=1e-4)
    assert "--film 10" in text
    assert f"| {float(rows['TFI']['flicker']):.3f} " in text


def test_true_flow_warps_the_ground_truth_of_a_film(base):
    middle, moved, still = (..., slice(16, 32), slice(16, 32)), 0.0, 0.0
    for scene in film_scenes(base.data, 41, 20):
        assert scene["spikes"].shape == (1, 121, 12, 12)
        for n, flow in zip((0, 2), scene["flow"], strict=True):
            there = flow_warp(scene["rgb"][n][None], flow[None])[0]
            moved += (there - scene["rgb"][1])[middle].abs().mean().item()
            still += (scene["rgb"][n] - scene["rgb"][1])[middle].abs().mean().item()
    assert moved < 0.7 * still, (moved, still)


def test_flicker_ignores_errors_that_move_with_the_scene():
    truth, flow = torch.rand(3, 3, 16, 16, generator=torch.Generator().manual_seed(0)), torch.zeros(3, 2, 16, 16)
    flow[:, 0] = 2.0
    then = truth.roll(2, dims=-1)
    error = torch.rand(3, 3, 16, 16)
    goes_along, comes = error.roll(2, dims=-1), torch.full_like(error, 4 / 255)
    assert (film_flicker(truth + error, then + goes_along, truth, then, flow) < 1e-3).all()
    found = film_flicker(truth, then + comes, truth, then, flow)
    torch.testing.assert_close(found, torch.full((3,), 4.0), rtol=0, atol=1e-3)
    outside = torch.zeros_like(error)
    outside[..., -2:] = 1.0  # from where the flow ends beyond the edge
    assert (film_flicker(truth + outside, then, truth, then, flow) < 1e-3).all()


def test_films_need_continuous_scenes(base, tmp_path, write_film):
    write_film(tmp_path / "film", 9)
    data = FilmScenes(str(tmp_path), scale=2)
    data.setup("test")
    with pytest.raises(UsageError, match="--film: expected a multiple of the 20 clocks of a source frame, got 10"):
        next(film_scenes(data, 41, 10))
    assert next(film_scenes(data, 41, 20))["rgb"].shape == (3, 3, 32, 48)
    with pytest.raises(UsageError, match="--film: expected still pictures in motion or films at full size, got"):
        next(film_scenes(LightningDataModule(), 41, 20))


@pytest.mark.slow
def test_work_and_weights_are_counted(traded, convolutions):
    rows = rows_of(traded)
    network = CSCSR(**WIDTHS)
    network(torch.zeros(1, 41, 12, 12), torch.zeros(1, 2, 2, 12, 12))
    count = sum(products for products, _ in convolutions)
    assert float(rows["as it is"]["macs"]) == pytest.approx(count / 144)
    assert int(rows["as it is"]["parameters"]) == sum(value.numel() for value in network.parameters())
    assert rows["TFI"]["parameters"] == "0"
    # nine tiles of 4 x 4 whose surroundings are the whole clip: what is counted is what predict does
    assert float(rows["small tiles"]["macs"]) == pytest.approx(9 * count / 144)


@pytest.mark.slow
def test_default_settings_run_on_own_weights(shared, checkpoint, tmp_path, monkeypatch):
    names = [*(f"own weights{name}" for name in ("", ", self-ensemble of 2")), "TFI", "TFP 13, order 3"]
    monkeypatch.setattr(cli, "usual_settings", lambda *of: [one for one in usual_settings(*of) if one.name in names])
    own = ["--ckpt_path", str(checkpoint), "--data.val_clips", "1"]
    main(["trade", *shared, *own, "--rounds", "1", "-o", str(tmp_path)])
    rows = rows_of(tmp_path)
    assert sorted(rows) == sorted(names)
    assert [name for name, row in rows.items() if row["failed"]] == []
    assert len({rows[name]["psnr"] for name in names}) == 4


def networks_of(settings):
    return [setting.name for setting in settings if setting.name.startswith("cscsr_") and "," not in setting.name]


def test_default_settings_are_the_networks_of_the_package_and_the_decoders():
    settings = {setting.name: setting for setting in usual_settings(4)}
    networks = networks_of(settings.values())
    sizes = "small", "micro", "tiny", "huge"  # the reference first
    assert networks == [*settings][: len(networks)] == [f"cscsr_{size}_x4" for size in sizes]
    two = ["--model.weights", "cscsr_tiny_x4", "--self_ensemble", "2"]
    assert settings["cscsr_tiny_x4, self-ensemble of 2"].args == two
    assert settings["TFI"].preset == Preset(network="ClassicalDecoder", method="tfi", scale=4, frames=41)
    assert all(setting.preset is not None for setting in settings.values())
    own = {setting.name: setting for setting in usual_settings(4, ["--ckpt_path"])}
    assert not networks_of(own.values())
    assert own["own weights"].args == []
    assert own["TFI"].args[-2:] == ["--ckpt_path", "null"]
    whole = usual_settings(4, ["--ckpt_path"], TSCNN(width=8, blocks=1))
    assert [one.name for one in whole if "own" in one.name and "tiles" in one.name] == []
    films = [setting.name for setting in usual_settings(4, film=True, frames=101)]
    assert {"cscsr_huge_long_x4", "cscsr_micro_x4, self-ensemble of 4"} < {*films}
    assert "cscsr_tiny_x4, self-ensemble of 2" not in films
    assert usual_settings(1)[0].name == "cscsr_small_x1"  # the reference has motion


@pytest.mark.parametrize(
    ("typed", "preset"),
    [
        ("--model.weights cscsr_small_x4 --tile=64", Preset("cscsr_small_x4", tile=64)),
        ("nothing:", Preset()),
        ("--model.network ClassicalDecoder --model.network.order 2", Preset(network="ClassicalDecoder", order=2)),
        ("-c my.yaml --model.weights cscsr_small_x4", None),
        ("--model.weights cscsr_small_x4 --model.weights cscsr_huge_x4", None),
        ("--model.weights cscsr_small_x4 --tile", None),
        ("--model.weights cscsr_small_x4 --tile wide", None),
        ("--model.weights cscsr_small_x4 --model.network CSCSR", None),
    ],
)
def test_arguments_become_a_preset_if_possible(typed, preset):
    assert read_setting(typed).preset == preset


def test_unnamed_setting_is_named_after_its_arguments():
    assert read_setting("-c 'a: b.yaml'  ") == ("-c 'a: b.yaml'", ["-c", "a: b.yaml"])
    assert read_setting("a, b|c: --tile 8") == ("a, b|c", ["--tile", "8"])


def test_presets_read_the_written_table(tmp_path, monkeypatch):
    """Presets read the table of a trade and skip rows that are no presets."""
    rows, _ = some_rows(3, [(9.0, 9.0), (2.0, 2.0), (1.0, 1.0)])
    typed = ["lost: --model.weights cscsr_huge_x4", f"tfi: {TFI}", "-c my.yaml --model.weights cscsr_small_x4"]
    for row, text in zip(rows, typed, strict=True):
        row.setting, row.memory = read_setting(text), 10.0
    rows[0].reason = "no such file"
    write_csv(rows, Timed(1, (8, 8), 2, "wall time"), tmp_path / "x4.csv")
    monkeypatch.setattr(presets, "_FOLDER", tmp_path)
    [choice] = presets.choices(presets.Conditions(4, (8, 8)))
    assert (choice.name, choice.preset, choice.ms) == ("tfi", Preset(network="ClassicalDecoder", method="tfi"), 2000.0)


MISTAKES = [
    (["--setting", "cscsr_small_x4"], "expected arguments of lightning test, or a name, a colon and such arguments"),
    (["--setting", "a:", "--setting", "a: --tile 8"], "two settings have the name 'a'"),
    (["--setting", "good:", "--setting", "a: --model.network.widht 3"], "widht"),
    (["--setting", "a: --data.motion 9"], "a: data.motion: expected 3.0, the same scenes for all, got 9.0"),
    (["--setting", "a: --model.network.frames 47"], "a: frames: expected at most the 41 of the clips, got 47"),
    (["-c", str(CONFIGS / "flow.yaml")], "FlowTraining"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("words", "said"), MISTAKES)
def test_errors_are_one_line_before_anything_runs(words, said, shared, tmp_path, monkeypatch):
    monkeypatch.setattr(cli, "measure", lambda *_: pytest.fail("something was run"))
    with pytest.raises(SystemExit, match=rf"^[^\n]*{re.escape(said)}[^\n]*$"):
        main(["trade", *shared, "-o", str(tmp_path / "out"), *words])
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_other_settings_continue_after_a_failure(shared, tmp_path, monkeypatch):
    def fail(*_):
        raise NotImplementedError("not for this\ndtype")

    monkeypatch.setattr(Spike2Flow, "channel_flows", fail)
    settings = ["--setting", "learned: --model.network.motion Spike2Flow", "--setting", "moving:"]
    main(["trade", *shared, *settings, "--rounds", "1", "-o", str(tmp_path)])
    rows = rows_of(tmp_path)
    assert rows["learned"]["failed"] == "NotImplementedError: not for this dtype"
    assert (rows["learned"]["psnr"], rows["learned"]["front"]) == ("", "")
    assert (rows["moving"]["ratio"], rows["moving"]["front"]) == ("1", "1")  # the first that ran
    with pytest.raises(SystemExit, match="no setting can run; learned: NotImplementedError: not for this dtype"):
        main(["trade", *shared, *settings[:2], "-o", str(tmp_path)])


@pytest.mark.slow
@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU is here")
@pytest.mark.parametrize("args", [["--trainer.accelerator", "gpu"], ["--trainer.precision", "16-mixed"]])
def test_missing_hardware_is_reported(args, shared, base):
    with pytest.raises(CannotRunError, match=r"gpu|16-mixed: not on this device"):
        make_runner(shared, args, base)


def test_shorter_network_takes_the_middle_of_the_clip(shared, base):
    fewer = ["--model.network.frames", "21", "--model.network.stride", "5"]
    runner = make_runner(shared, fewer, base)
    spikes = (torch.rand(1, 41, 12, 12, generator=torch.Generator().manual_seed(0)) < 0.3).to(torch.uint8)
    with torch.no_grad():
        expected = runner.network(spikes[:, 10:31]).clamp(0, 1)
    assert torch.equal(runner(spikes), expected)


class Remember:
    """A runner that only remembers what it was run on."""

    device = torch.device("cpu")
    network = torch.nn.Linear(2, 3)

    def __init__(self, name, calls):
        self.name, self.calls = name, calls

    def __call__(self, spikes):
        self.calls.append((self.name, int(spikes.sum())))


def some_rows(count, seconds=()):
    calls, rows = [], []
    for name in "abcdefghi"[:count]:
        rows.append(Measurement(Setting(name, []), Remember(name, calls), psnr=[20.0], ssim=[0.5], macs=100.0))
    for row, times in zip(rows, seconds, strict=False):
        row.seconds = list(times)
    return rows, calls


def test_settings_are_timed_in_rotating_order_on_the_same_clip():
    rows, calls = some_rows(3)
    time_in_turns(rows, [torch.full((1, 1, 1, 1), n) for n in range(2)], 6)
    assert calls == [(name, n % 2) for n, turn in enumerate(["abc", "bca", "cab"] * 2) for name in turn]
    assert [len(row.seconds) for row in rows] == [6, 6, 6]


def test_ratios_are_taken_within_a_round():
    rows, _ = some_rows(2, [(1.0, 10.0, 2.0), (2.0, 20.0, 4.0)])
    lost = Measurement(Setting("lost", []), reason="no such thing")
    first, second, third = figures([rows[0], rows[1], lost])
    assert (first["ratio"], second["ratio"], second["ratio_q3"]) == (1, 2, 2)
    rows[1].seconds = [2.0, 30.0, 1.0]
    assert figures(rows)[1]["ratio"] == 2  # the median of 2, 3 and 0.5; the ratio of the medians is 1
    assert second["ms"] == 4000
    assert third == {}


def test_front_against_brute_force():
    chance = random.Random(0)
    for _ in range(100):
        points = [(chance.randint(0, 6), chance.randint(0, 6)) for _ in range(chance.randint(1, 9))]
        rows, _ = some_rows(len(points), [(float(ms),) for ms, _ in points])
        for row, (_, db) in zip(rows, points, strict=True):
            row.psnr = [float(db)]
        found = front(rows)
        beaten = [any(c <= ms and v >= db and (c, v) != (ms, db) for c, v in points) for ms, db in points]
        assert sorted(found) == [n for n in range(len(points)) if not beaten[n]]
        assert [points[n][0] for n in found] == sorted(points[n][0] for n in found)
