"""Choice of presets by speed and budget."""

import csv
from dataclasses import replace
from itertools import pairwise, product

import pytest
import torch

from lightning_modules.inference import presets as speed
from lightning_modules.inference.presets import SPEEDS, Conditions, Preset, choices, choose, pace
from lightning_modules.networks import CSCSR, RecurrentCSCSR
from lightning_modules.registry import find_model
from lightning_modules.storage.pretrained import settings_of

HEADER = ["setting", *vars(Preset()), "psnr", "ratio", "mib", "reference", "height", "width", "failed", "ms"]
WEIGHTS = {"weights": "tiny.ckpt"}
DECODER = {"network": "ClassicalDecoder"}
ROWS = [
    ("tfi", 25.0, 4, 2, DECODER | {"method": "tfi"}, ""),
    ("all", 30.0, 400, 80, WEIGHTS, ""),
    ("no tiles", 30.0, 350, 20, WEIGHTS | {"tile": 0}, ""),
    ("small tiles", 30.0, 500, 20, WEIGHTS | {"tile": 16}, ""),
    ("faster", 29.85, 200, 70, WEIGHTS, ""),
    ("tfp", 29.6, 10, 5, DECODER | {"method": "tfp"}, ""),
    ("tfp 5", 24.0, 3.8, 3, DECODER | {"method": "tfp", "window": 5}, ""),
    ("bf16", 30.1, 300, 60, WEIGHTS | {"precision": "bf16-true"}, ""),
    ("what no column says", 31.0, 1, 90, {}, ""),
    ("broken", "", "", "", {"weights": "nowhere"}, "there is none"),
]


@pytest.fixture(name="table")
def _table(tmp_path, monkeypatch):
    network = CSCSR(3, width=4, representation_width=4, features=1, stages=1, end_blocks=1)
    state = {f"network.{name}": value for name, value in network.state_dict().items()}
    torch.save({"state_dict": state, "network": settings_of(network), "motion": {}}, tmp_path / "tiny.ckpt")
    with open(tmp_path / "x3.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, HEADER, restval="")
        writer.writeheader()
        for name, psnr, ms, mib, columns, failed in ROWS:
            if "weights" in columns:
                columns = columns | {"weights": tmp_path / columns["weights"]}
            row = {"setting": name, "psnr": psnr, "mib": mib, "height": 40, "width": 50, "failed": failed}
            # single times were disturbed: ratios to the reference, here the second row, were taken in turns
            times = {"ratio": ms and ms / 400, "ms": 400 if name == "all" else 1, "reference": "all"}
            writer.writerow(row | times | columns)
    monkeypatch.setattr(speed, "_FOLDER", tmp_path)
    monkeypatch.setattr(speed, "pace", lambda *_: 1.0)
    return tmp_path


@pytest.mark.parametrize(
    ("wish", "expected"),
    [
        ({"speed": "best"}, "all"),
        ({"speed": "balanced"}, "faster"),
        ({"speed": "fast"}, "tfp"),
        ({"speed": "fastest"}, "tfi"),
        ({"budget": "400ms"}, "all"),
        ({"budget": "399ms", "size": (20, 50)}, "all"),
        ({"budget": "399ms", "size": (80, 100)}, "tfp"),
        ({"budget": "20MiB"}, "small tiles"),
        ({"budget": "20MB"}, "tfp"),
        ({"budget": "0.4s"}, "all"),
        ({"budget": "2.6 fps"}, "faster"),
    ],
)
def test_speeds_and_budgets_scale_with_the_frame(table, wish, expected):
    size = wish.pop("size", (40, 50))
    assert choose(Conditions(3, size), **wish).name == expected


@pytest.mark.parametrize("kind", ["film", "grey"])
def test_films_and_grey_cameras_have_their_own_tables(table, kind):
    asked = Conditions(3, **{kind: True})
    assert choose(asked, "fastest") == choose(Conditions(3), "fastest")  # as long as there is none
    lines = (table / "x3.csv").read_text().splitlines()
    (table / f"x3_{kind}.csv").write_text("\n".join(line for line in lines if not line.startswith("tfi")))
    assert choose(replace(asked, film=True), "fastest").name == "tfp 5"
    assert choose(Conditions(3), "fastest").name == "tfi"
    with pytest.raises(ValueError, match=r"expected one that was measured \(x3\), got 4"):
        choose(replace(asked, scale=4), "fastest")


def test_same_network_for_films_and_single_clips():
    for scale in (2, 3, 4):
        film, picture = (choose(Conditions(scale, film=film), "balanced").preset for film in (True, False))
        assert film.weights == picture.weights
        assert isinstance(film.build(), RecurrentCSCSR) == find_model(film.weights).film


def test_time_budget_is_for_this_machine(table, monkeypatch):
    monkeypatch.setattr(speed, "pace", lambda *_: 2.0)
    choice = choose(Conditions(3, (40, 50)), budget="400ms")
    assert (choice.name, choice.ms) == ("faster", 2 * 200)
    assert choose(Conditions(3, (40, 50)), budget="1GB").ms == 400  # memory is the same here


@pytest.mark.usefixtures("table")
def test_pace_is_measured_on_the_reference(monkeypatch):
    """A frame takes four times as long as a quarter of a clip; the table has 400 ms."""

    def timer(work, number):
        work()
        return 1.0

    monkeypatch.setattr(speed, "timer_of", lambda device, threads: (timer, "a second whatever it does"))
    assert pace(Conditions(3)) == 4 * 1000 / 400


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"speed": "quick"}, "speed: expected one of fastest, fast, balanced, best, got 'quick'"),
        ({"speed": "fast", "budget": "1s"}, "expected one of them"),
        ({"budget": "40"}, "budget: expected a time or memory"),
        ({"budget": "1ms"}, "no preset fits 1ms at 250 x 400 sensor pixels; leanest: tfp 5: about 190 ms"),
        ({"budget": "1MB"}, "no preset fits 1MB at 250 x 400 sensor pixels; leanest: tfi"),
        ({"scale": 7, "speed": "fast"}, r"scale: expected one that was measured \(x3\), got 7"),
    ],
)
def test_invalid_speeds_and_budgets_are_rejected(table, arguments, message):
    with pytest.raises(ValueError, match=message):
        choose(Conditions(arguments.pop("scale", 3)), **arguments)


def test_presets_survive_writing_and_reading():
    for given in ({}, WEIGHTS | {"self_ensemble": 2, "tile": 0}):
        preset = Preset(**given)
        assert Preset.read({name: "" if cell is None else str(cell) for name, cell in vars(preset).items()}) == preset
        assert preset.given(*vars(Preset())) == given
    with pytest.raises(ValueError, match="invalid literal"):
        Preset.read({"tile": "wide"})


def test_invalid_presets_are_rejected():
    for nothing in (Preset(tile=32), Preset(network="CSCSR")):
        with pytest.raises(ValueError, match="preset: expected weights, or ClassicalDecoder as network"):
            nothing.build()


def test_tables_of_the_package_are_valid():
    for scale, grey in ((1, True), (1, False), (2, False), (3, False), (4, False)):
        conditions = Conditions(scale, frames=101, grey=grey)
        picked = list(dict.fromkeys(choose(conditions, name) for name in SPEEDS))
        assert len(picked) == len(SPEEDS)
        assert all(faster.ms < 0.9 * slower.ms for faster, slower in pairwise(picked))  # every speed is worth its name
        assert picked[-2].preset.self_ensemble is None  # several views are for the best alone
        reference = speed._reference(speed._table(conditions))
        assert (reference["ratio"], Preset.read(reference)) == ("1", Preset(reference["setting"]))
        for choice in choices(conditions):
            assert (find_model(choice.preset.weights).scale if choice.preset.weights else choice.preset.scale) == scale


def test_noisy_sensors_get_weights_for_noise_at_the_same_cost():
    for scale, film, frames in product((1, 2, 3, 4), (False, True), (41, 101)):
        conditions = Conditions(scale, film=film, frames=frames)
        noisy = choices(replace(conditions, noisy=True))
        ideal = {choice.name: choice for choice in choices(conditions)}
        assert noisy[0].preset.network == "ClassicalDecoder" != noisy[-1].preset.network  # nothing to train
        for choice in noisy:
            assert choice.preset.weights is None or find_model(choice.preset.weights).noise
            assert any(choice.ms == other.ms and choice.psnr == other.psnr for other in ideal.values())
        assert min(choice.below for choice in noisy) == 0
