"""``lightning sweep``; most trials run in this process."""

import copy
import csv
import re
import statistics
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import yaml

from lightning_modules.__main__ import main
from lightning_modules.cli.command import run
from lightning_modules.cli.errors import InputError
from lightning_modules.storage.checkpoint import DivergedError
from lightning_modules.sweep import cli, worker
from lightning_modules.sweep.state import RESULT, read_result, say_progress, write_json
from lightning_modules.sweep.table import collect, markdown, reference
from lightning_modules.sweep.trials import Trial, _Resolver, make_trials

CONFIGS = Path(__file__).parents[3] / "configs"

TINY = """
model:
  network:
    init_args: {width: 4, representation_width: 4, features: 1, stages: 1, blocks: 1, end_blocks: 1}
data:
  init_args: {patch: 8, val_patch: 12, train_clips: 8, val_clips: 2, batch_size: 2, workers: 0}
trainer:
  check_val_every_n_epoch: 1
  log_every_n_steps: 2
"""
COSINE = """
model:
  lr_scheduler:
    class_path: torch.optim.lr_scheduler.CosineAnnealingLR
    init_args: {T_max: 1000, eta_min: 1.0e-5}
"""


@pytest.fixture(scope="module")
def overlays(tmp_path_factory):
    folder = tmp_path_factory.mktemp("overlays")
    for name, text in (
        ("tiny", TINY),
        ("cosine", COSINE),
        ("diverges", "model: {optimizer: {init_args: {lr: 1.0e+30}}}"),
        ("wide", "model: {network: {init_args: {width: 6}}}"),
    ):
        (folder / f"{name}.yaml").write_text(text)
    return folder


@pytest.fixture(scope="module")
def typed(overlays):
    return ["sweep", str(CONFIGS / "x4.yaml"), "-c", str(overlays / "tiny.yaml")]


def trials_here(folders, jobs, every):
    """An engine that runs trials in this process, and says of all at once how they ended: that draws one plot."""
    ended = {}
    for folder in folders:
        try:
            ended[folder] = worker.train_and_test(folder, every)
        except DivergedError as error:
            ended[folder] = str(error)
    yield ended


@pytest.fixture(autouse=True, scope="module")
def _in_this_process():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(cli._ENGINES, "local", trials_here)
        yield


def one_trial_here(folders, jobs, every):
    """An engine that runs one trial in this process, and makes up the results of the others from its result."""
    first, *others = folders
    worker.train_and_test(first, every)
    result = read_result(first)
    for n, folder in enumerate(others, 1):
        scores = {name: value + n**2 / 8 for name, value in result["scores"].items()}
        write_json(folder / RESULT, {**result, "scores": scores})
    yield dict.fromkeys(folders)


@pytest.fixture(scope="module")
def swept(typed, tmp_path_factory):
    """C and J, two seeds."""
    output = tmp_path_factory.mktemp("sweep")
    variants = [str(CONFIGS / "ablation" / f"{name}.yaml") for name in "cj"]
    command = [*typed, "--over", *variants, "--seeds", "0", "1", "--steps", "4", "-o", str(output)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(cli._ENGINES, "local", one_trial_here)
        main(command)
    return output, command


def table(output):
    return list(csv.DictReader((output / "sweep.csv").open()))


def weights(folder):
    return torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)


def test_combinations_have_names_and_configurations(overlays, tmp_path):
    configs = [CONFIGS / "x4.yaml", overlays / "tiny.yaml"]
    variants = [[CONFIGS / "ablation/b.yaml", CONFIGS / "ablation/j.yaml"]]
    sets = ["model.network.features=1,2", "data.brightness=[0.5,0.8]"]
    trials = make_trials(configs, variants, sets, [3, 4], {"steps": 5}, tmp_path)
    names = [f"{v}-features={f}-seed{s}" for v in "bj" for f in (1, 2) for s in (3, 4)]
    assert [trial.folder.name for trial in trials] == names
    for trial in trials:
        variant, features = trial.labels
        network = trial.config["model"]["init_args"]["network"]["init_args"]
        assert network["global_perception"] == (variant == "j")
        assert f"features={network['features']}" == features
        assert network["width"] == 4  # of the overlay below
        assert trial.config["seed_everything"] == trial.seed
        assert trial.config["trainer"]["max_steps"] == 5
        assert trial.config["data"]["init_args"]["brightness"] == [0.5, 0.8]
        assert trial.config["output"] == str(trial.folder)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_table_matches_the_tests(swept):
    output, _ = swept
    rows = table(output)
    order = [(variant, seed) for variant in "cj" for seed in ("0", "1", "mean", "spread")]
    assert [(row["variant"], row["seed"]) for row in rows] == order
    c, j = psnr = [], []
    for row in rows:
        scores = psnr[row["variant"] == "j"]
        if row["seed"] in ("mean", "spread"):
            of = {"mean": statistics.mean, "spread": statistics.stdev}[row["seed"]]
            assert float(row["psnr"]) == pytest.approx(of(scores), abs=1e-4)
            continue
        folder = output / f"{row['variant']}-seed{row['seed']}"
        mean = read_result(folder)["scores"]
        if row is rows[0]:
            tested = csv.DictReader((folder / "test.csv").open())
            mean = next(line for line in tested if line["method"] == "CSCSR" and line["clip"] == "mean")
        assert all(row[name] == str(round(float(mean[name]), 4)) for name in ("psnr", "ssim"))
        assert row["steps"] == "4"
        scores.append(float(row["psnr"]))
    assert c[0] != c[1]
    gaps = [ours - theirs for ours, theirs in zip(c, j, strict=True)]
    lines = (line.strip("| ").split(" | ") for line in (output / "sweep.md").read_text().splitlines()[:4])
    header, _, c_row, _ = ([cell.strip() for cell in line] for line in lines)
    cells = dict(zip(header, c_row, strict=True))
    assert cells["n"] == "2"
    assert cells["PSNR (dB)"] == f"{statistics.mean(c):.2f} ± {statistics.stdev(c):.2f}"
    assert cells["PSNR (dB) - j"] == f"{statistics.mean(gaps):+.2f} ± {statistics.stdev(gaps):.2f}"
    assert cells["parameters"] == "5,019"


@pytest.mark.slow
def test_finished_trials_are_kept_and_other_settings_rejected(swept, capsys, monkeypatch):
    output, command = swept
    files = [path for path in output.rglob("*") if path.is_file() and path.parent != output]
    before = {path: path.stat().st_mtime_ns for path in files}
    monkeypatch.setitem(cli._ENGINES, "local", lambda *_: pytest.fail("something was run"))
    main(command)
    assert "4 trials, 4 of them finished before" in capsys.readouterr().out
    config = yaml.safe_load((output / "c-seed0" / "trial.yaml").read_text())
    wider = copy.deepcopy(config)
    wider["model"]["init_args"]["network"]["init_args"]["width"] = 5
    for there, steps, message in ((config, 5, "budget.steps=4"), (wider, 4, "model.network.width=4")):
        with pytest.raises(InputError, match=f"c-seed0: holds .*{message}, expected 5 for this sweep"):
            Trial(("c",), 0, output / "c-seed0", there, {"steps": steps}).write()
    assert {path: path.stat().st_mtime_ns for path in files} == before


@pytest.mark.slow
def test_killed_sweep_resumes_exactly(typed, overlays, tmp_path, monkeypatch, forked):
    # epochs of 6 steps; two trials that train alike, of which the sweep is killed during the first
    sets = ["--set", "data.train_clips=12", "--set", "data.val_clips=1", "--set", "trainer.log_every_n_steps=1,2"]
    command = [*typed, "-c", str(overlays / "cosine.yaml"), *sets, "--steps", "10", "-o", str(tmp_path / "broken")]
    first, second = (tmp_path / "broken" / f"log_every_n_steps={steps}" for steps in (1, 2))
    with monkeypatch.context() as patch:
        patch.setitem(cli._ENGINES, "local", cli.run_locally)
        sweep = forked([*command, "--every", "0.01"])
    until = time.monotonic() + 200
    while not (first / "checkpoints" / "last.ckpt").is_file():
        assert sweep.is_alive()
        assert time.monotonic() < until
        time.sleep(0.02)
    sweep.kill()  # and nobody tells the trial
    sweep.join()
    time.sleep(1)
    reached = (first / "checkpoints" / "last.ckpt").stat().st_mtime_ns
    assert 1 <= weights(first)["global_step"] < 10
    time.sleep(1)
    assert (first / "checkpoints" / "last.ckpt").stat().st_mtime_ns == reached  # the trial has ended with the sweep
    assert not list(second.glob("checkpoints"))

    main(command)
    ours, theirs = weights(first), weights(second)
    assert ours["global_step"] == theirs["global_step"] == 10
    assert all(ours["state_dict"][key].equal(value) for key, value in theirs["state_dict"].items())
    assert (first / "test.csv").read_text() == (second / "test.csv").read_text()
    # it went on: the step after a start is not timed
    assert ours["callbacks"]["Report"]["steps"] == theirs["callbacks"]["Report"]["steps"] - 1
    # the schedule ended with the budget
    assert theirs["optimizer_states"][0]["param_groups"][0]["lr"] == pytest.approx(1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["local", "ray"])
def test_other_trials_continue_after_a_failure(engine, typed, overlays, tmp_path, capsys):
    if engine == "ray":
        pytest.importorskip("ray", reason="Ray is an extra")
    over = [str(overlays / "diverges.yaml"), str(overlays / "wide.yaml")]
    command = [*typed, "--over", *over, "--steps", "4", "--engine", engine, "-o", str(tmp_path / "out")]
    with pytest.raises(SystemExit, match="lightning: sweep: 1 of 2 trials failed"):
        main(command)
    # a loss, or the weights after it: which is seen first depends on the processor and on its load
    why = r"the loss is nan at step [1-4]|.*best.ckpt: not written, as the training has diverged"
    assert re.search(rf"diverges  FAILED: ({why})", capsys.readouterr().out)
    first, *_, last = table(tmp_path / "out")
    assert re.match(why, first["failed"])
    assert (last["variant"], last["seed"]) == ("wide", "spread")
    assert re.search(r"\| diverges +\| 0, 1 failed +\|", (tmp_path / "out" / "sweep.md").read_text())
    if engine == "ray":
        main([*typed, "--over", over[1], "--steps", "4", "-o", str(tmp_path / "local")])
        ours, theirs = (weights(tmp_path / folder / "wide")["state_dict"] for folder in ("out", "local"))
        assert all(ours[name].equal(value) for name, value in theirs.items())


@pytest.mark.slow
def test_flops_count_all_accumulated_batches(overlays, tmp_path, convolutions):
    configs = [CONFIGS / "x4.yaml", overlays / "tiny.yaml", overlays / "cosine.yaml"]
    accumulated = ["trainer.accumulate_grad_batches=1,2"]
    one, two = make_trials(configs, [], accumulated, [], {"flops": 1e9}, tmp_path)
    counted, steps = [], []
    for trial in (one, two):
        trial.write()
        text = worker.plan(trial.folder).read_text()
        counted.append(float(re.search(r"(\S+) FLOPs", text).group(1)))
        planned = yaml.safe_load(text)
        steps.append(planned["trainer"]["max_steps"])
        assert planned["model"]["init_args"]["lr_scheduler"]["init_args"]["T_max"] == steps[-1]

    built = run(["fit", "-c", str(one.folder / "trial.yaml")], _Resolver)
    batch = next(iter(built.datamodule.train_dataloader()))
    convolutions.clear()
    built.model.network(batch["spikes"], batch["flow"])
    # forward, for the weights, and for what comes in where that was computed
    count = sum(2 * products * (2 + computed) for products, computed in convolutions)
    assert counted == pytest.approx([count, 2 * count], rel=1e-4)
    assert steps == [int(1e9 / count), int(1e9 / (2 * count))]
    (one.folder / "plan.yaml").write_text("# a resumed trial keeps its plan")
    assert worker.plan(one.folder).read_text() == "# a resumed trial keeps its plan"


def test_time_budget_ends_training_and_schedule(overlays, tmp_path):
    configs = [CONFIGS / "x4.yaml", overlays / "tiny.yaml", overlays / "cosine.yaml"]
    for files, schedule, callbacks in ((configs[:2], "StepLR", []), (configs, "ConstantLR", ["Pace"])):
        [trial] = make_trials(files, [], [], [], {"seconds": 3600}, tmp_path)
        trainer, model = trial.config["trainer"], trial.config["model"]["init_args"]
        assert (trainer["max_time"], trainer["max_steps"]) == ({"seconds": 3600}, -1)
        assert model["lr_scheduler"]["class_path"].endswith(schedule)
        assert [one["class_path"].rpartition(".")[2] for one in trainer["callbacks"] or []] == callbacks
        run(["fit", "-c", str(_written(trial))], _Resolver)


def _written(trial):
    trial.write()
    return trial.folder / "trial.yaml"


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ([], "expected a configuration, such as x4, got none"),
        (["X", "--time", "1:60:00"], "--time: expected HH:MM:SS or DD:HH:MM:SS, got 1:60:00"),
        (["X", "--time", "00:00:00"], "--time: expected a time above 0, got 00:00:00"),
        (["X", "--set", "width"], "--set: expected KEY=VALUE"),
        (["X", "--set", "model.network.widht=8,16"], "widht=8: model.network: Option 'widht' is not accepted"),
        (["X", "--set", "data.motion=1,-1"], "motion=-1: motion: expected 0 or more, got -1.0"),
        (["X", "--set", "trainer.devices=2"], "trainer.devices: expected 1 for a trial, got 2"),
        (["X", "--over", "nowhere.yaml"], "nowhere: config: File does not exist"),
        (["X", "--over", "X", "X"], "two trials have the name x4"),
        (["X", "--set", "ckpt_path=last"], "ckpt_path: expected none, "),
        (["X", "--set", "output=there"], "--set: expected the folder of the sweep as -o DIR, got output=there"),
        (["X", "--set", "trainer.max_steps=5,6", "--steps", "4"], "same settings for max_steps=5 and max_steps=6"),
        (
            ["X", "--set", "model.weights=cscsr_small_x4", "--over", "A", "J", "--seeds", "0", "1"],
            "same settings for a-seed0 and j-seed0; the network of model.weights=cscsr_small_x4 overrides",
        ),
    ],
)
def test_errors_are_one_line_before_anything_is_written(args, message, tmp_path):
    files = {"X": "x4.yaml", "A": "ablation/a.yaml", "J": "ablation/j.yaml"}
    words = [str(CONFIGS / files[word]) if word in files else word for word in args]
    with pytest.raises(SystemExit) as exit:
        main(["sweep", *words, "-o", str(tmp_path / "sweep")])
    assert message in str(exit.value)
    assert str(exit.value).startswith("lightning: ")
    assert "\n" not in str(exit.value)
    assert not (tmp_path / "sweep").exists()


def test_foreign_folders_are_rejected(typed, tmp_path):
    (tmp_path / "tiny").mkdir()
    (tmp_path / "tiny" / "notes.txt").touch()
    with pytest.raises(SystemExit, match="tiny: is not empty, and holds no trial"):
        main([*typed, "-o", str(tmp_path)])


def test_result_combines_checkpoint_and_test(tmp_path):
    network = {"class": "RecurrentCSCSR", "scale": 4}
    state = {"state_dict": {}, "network": network, "global_step": 6, "pytorch-lightning_version": "2.6.0"}
    torch.save(state, tmp_path / "last.ckpt")
    report = SimpleNamespace(seconds=3.0, steps=6, parameters=100)
    tested = "method,clip,psnr\nTFI,mean,1.5\nRecurrentCSCSR,mean,2.5\nRecurrentCSCSR,0,9\n"
    for more, psnr in ("", 2.5), ('"RecurrentCSCSR, film",mean,3.5\n', 3.5):
        (tmp_path / "test.csv").write_text(tested + more)
        assert worker._result(tmp_path, tmp_path / "last.ckpt", report) == {
            "scores": {"psnr": psnr},
            "steps": 6,
            "seconds_per_step": 0.5,
            "parameters": 100,
        }
    (tmp_path / "test.csv").write_text(tested.replace("2.5", "nan"))
    with pytest.raises(DivergedError, match="psnr: expected a number, got nan"):
        worker._result(tmp_path, tmp_path / "last.ckpt", report)


def test_variants_are_compared_with_j_or_the_first(tmp_path):
    names = [("c", "size=tiny"), ("j", "size=tiny"), ("c", "size=small"), ("j", "size=small"), ("c", "size=large")]
    rows = collect([Trial(name, None, tmp_path / "-".join(name), {}, {}) for name in names], {})
    assert [reference(row, rows).labels for row in rows] == [names[1], names[1], names[3], names[3], names[0]]
    assert "Not finished: 5 trials." in markdown(rows)


@pytest.fixture
def started(monkeypatch):
    """Processes of trials by their names, each of which runs the code in the file ``code`` of its folder."""
    start, processes = subprocess.Popen, {}

    def start_one(command, **options):
        folder = Path(command[3])
        processes[folder.name] = start([sys.executable, str(folder / "code")], **options)
        return processes[folder.name]

    monkeypatch.setattr(subprocess, "Popen", start_one)
    return processes


def test_trials_report_how_their_process_ended(started, tmp_path, monkeypatch):
    ends = {
        "fine": ("pass", None),
        "fails": ("import sys; print('before'); sys.exit('lightning: no such thing')", "no such thing"),
        "killed": ("import os; os.kill(os.getpid(), 9)", "killed by SIGKILL, perhaps out of memory"),
        "threads": ("import os, sys; sys.exit(os.environ['OMP_NUM_THREADS'])", "2"),
    }
    monkeypatch.setattr(torch, "get_num_threads", lambda: 6)
    for name, (code, _) in ends.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "code").write_text(code)
    found = {}
    for ended in cli.run_locally([tmp_path / name for name in ends], 3, 60):
        found |= {folder.name: reason for folder, reason in ended.items()}
    assert list(started) == list(ends)
    assert found == {name: reason for name, (_, reason) in ends.items()}


def test_trials_end_with_the_sweep(started, tmp_path):
    (tmp_path / "code").write_text("import sys; sys.stdin.read()")
    running = cli.run_locally([tmp_path], None, 60)
    next(running)
    [process] = started.values()
    assert process.poll() is None
    running.close()
    assert process.poll() == 0


def test_output_of_a_failed_trial(typed, tmp_path, capsys, monkeypatch):
    def engine(folders, *_):
        say_progress(folders[0], "step 30\x1b[31m")
        yield {}
        yield {folders[0]: None}  # as one whose process SIGTERM ended

    monkeypatch.setitem(cli._ENGINES, "local", engine)
    with pytest.raises(SystemExit, match="1 of 1 trials failed; the same command"):
        main([*typed, "-o", str(tmp_path)])
    failed = f"tiny  FAILED: ended without a result ({tmp_path / 'tiny' / 'log.txt'})"
    assert capsys.readouterr().out.splitlines()[1:3] == ["tiny  step 30?[31m", failed]
    assert "failed: ended without a result" in (tmp_path / "sweep.md").read_text()


def test_missing_ray_is_reported(typed, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(SystemExit, match=r"pip install '.\[ray\]' in a clone"):
        main([*typed, "--engine", "ray", "-o", str(tmp_path)])
