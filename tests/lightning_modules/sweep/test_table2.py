"""The paper's Table 2 beside ours, and what every method costs."""

import csv
import json
import sys

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from lightning_modules.__main__ import main
from lightning_modules.networks import VidarSR
from lightning_modules.sweep import cli, cost, worker
from lightning_modules.sweep.paper import TABLE_2, TABLE_3, method_of
from lightning_modules.sweep.plot import _paper_gap
from lightning_modules.sweep.table import collect, markdown, reference, write_csv
from lightning_modules.sweep.trials import Trial

VIDARSR = {"class": "VidarSR", "scale": 4, "per_channel": True, "width": 64}
RAWVSR = {"class": "RealRawVSR", "scale": 4, "decoder": "tfp", "width": 64, "blocks": 10}
CSCSR = {"class": "CSCSR", "scale": 4, "width": 32}


def finished(folder, label, network, *psnr, letter=""):
    """Trials of a variant, a seed each, and what they leave."""
    trials = []
    for seed, value in enumerate(psnr):
        trial = Trial((label,), seed, folder / f"{label}-seed{seed}", {}, {}, letter)
        trial.folder.mkdir(parents=True)
        result = {
            "metrics": {network["class"]: {"psnr": value, "ssim": 0.5}},
            "method": network["class"],
            "steps": 4,
            "seconds_per_step": 0.5,
            "parameters": 1000,
            "network": network,
            "optimizer": {"lr": 1e-4, "weight_decay": 0},
        }
        (trial.folder / "result.json").write_text(json.dumps(result))
        trials.append(trial)
    return trials


@pytest.fixture(name="trials")
def _trials(tmp_path):
    return [
        *finished(tmp_path, "vidarsr_star", VIDARSR, 20.0, 20.5),
        *finished(tmp_path, "tfp_real_rawvsr", RAWVSR, 22.0, 22.5),
        *finished(tmp_path, "e", CSCSR, 23.0, 23.25),
        *finished(tmp_path, "l", {**CSCSR, "width": 64}, 24.0, 24.25),
    ]


def cells(text):
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]
    return {line[0]: dict(zip(lines[0], line, strict=True)) for line in lines[2:]}


def test_the_paper_is_copied_right():
    assert [len(methods) for methods in TABLE_2.values()] == [11, 11, 11]
    assert {len(data) for scale in (2, 3) for data in TABLE_2[scale].values()} == {2}
    for scale, methods in TABLE_2.items():
        assert methods["CSCSR"]["REDS"].psnr == TABLE_3[scale]["J"]
        for data in methods["CSCSR"]:
            best = max(methods, key=lambda name: methods[name][data].psnr)
            assert best == ("TFP+TSCNN" if (scale, data) == (4, "Vimeo") else "CSCSR")  # as the paper has it
            assert all(0 < scores.lpips < 0.5 < scores.ssim < 1 for scores in (m[data] for m in methods.values()))
        for name in ("VidarSR", "SpikeSR-Net"):
            assert methods[name]["Vid4"].psnr > methods[f"{name}*"]["Vid4"].psnr
    assert TABLE_2[4]["VidarSR*"]["REDS"] == (26.51, 0.7135, 0.4135)
    assert TABLE_2[3]["3DRI+BasicVSR"]["Vid4"] == (24.08, 0.7568, 0.3135)
    assert TABLE_2[4]["SpikeSR-Net"]["Vimeo"] == (25.27, 0.7611, 0.3119)


@pytest.mark.parametrize(
    ("network", "name"),
    [
        (VIDARSR, "VidarSR*"),
        ({**VIDARSR, "per_channel": False}, "VidarSR"),
        (RAWVSR, "TFP+Real-RawVSR"),
        ({"class": "TSCNN", "decoder": "tfi"}, "TFI+TSCNN"),
        ({"class": "SwinIR"}, "3DRI+SwinIR"),
        ({"class": "BasicVSR"}, "3DRI+BasicVSR"),
        ({"class": "SpikeSRNetLike", "per_channel": True}, "SpikeSR-Net*"),
        (CSCSR, "CSCSR"),
        ({"class": "ClassicalDecoder", "method": "tfi"}, None),
        ({}, None),
    ],
)
def test_rows_are_those_of_the_paper(network, name):
    assert method_of(network) == name


def test_table_2_stands_beside_ours(trials, tmp_path):
    rows = collect(trials, {})
    table = cells(markdown(rows))
    star = table["vidarsr_star"]
    assert (star["method"], star["paper, PSNR on REDS (dB)"], star["paper - CSCSR"]) == ("VidarSR*", "26.51", "-2.26")
    assert star["paper, Vid4: PSNR / SSIM / LPIPS"] == "21.58 / 0.5880 / 0.4395"
    assert star["paper, Vimeo: PSNR / SSIM / LPIPS"] == "24.64 / 0.7352 / 0.3423"
    assert star["PSNR (dB) - e"] == "-2.88 ± 0.18"
    assert (table["e"]["PSNR (dB) - e"], table["l"]["PSNR (dB) - e"]) == ("", "+1.00 ± 0.00")
    assert {table[size]["method"] for size in "el"} == {"CSCSR"}
    assert not {"`per_channel`", "`decoder`", "`blocks`"} & star.keys()  # which not all of them have
    assert star["`width`"] == "64"
    assert [reference(row, rows).variant for row in rows] == ["e"] * 4
    assert [_paper_gap(row, rows) for row in rows] == pytest.approx([-2.26, -1.45, 0, 0])
    write_csv(rows, tmp_path / "sweep.csv")
    with open(tmp_path / "sweep.csv") as file:
        written = list(csv.DictReader(file))
    for row in written[:3]:
        paper = [row[f"paper_{name}"] for name in ("psnr", "reds_psnr", "vid4_ssim", "vimeo_lpips")]
        assert (row["method"], *paper) == ("VidarSR*", "26.51", "26.51", "0.588", "0.3423")


def test_sizes_by_themselves_are_no_table_2(trials):
    rows = collect(trials[4:], {})
    header = next(iter(cells(markdown(rows)).values())).keys()
    assert not [name for name in header if "paper" in name or name == "method"]
    assert [row.paper for row in rows] == [None, None]


def test_an_ablation_keeps_its_row_of_table_3(tmp_path, trials):
    trials += finished(tmp_path, "f", {**CSCSR, "search": False}, 22.0, letter="F")
    *others, row = collect(trials, {})
    assert (row.method, row.paper, row.paper_scores) == (None, TABLE_3[4]["F"], {})
    assert all(other.method for other in others)


def test_costs_stand_in_the_same_table(trials, tmp_path):
    rows = collect(trials, {})
    costs = {"variants": {"e": {"ms": 12.345, "mib": 100.0, "macs": 1_480_320.0}}, "where": "a clip of 8 x 9"}
    text = markdown(rows, costs)
    table = cells(text)
    measured = "ms a frame", "MiB", "MAC a pixel"
    assert [table["e"][name] for name in measured] == ["12.35", "100", "1,480,320"]
    assert [table["l"][name] for name in measured] == ["", "", ""]
    assert "a clip of 8 x 9" in text
    write_csv(rows, tmp_path / "sweep.csv", costs)
    with open(tmp_path / "sweep.csv") as file:
        written = {(row["variant"], row["seed"]): row for row in csv.DictReader(file)}
    assert [written["e", "mean"][name] for name in ("ms", "mib", "macs")] == ["12.345", "100.0", "1480320.0"]
    assert [written["e", "0"][name] for name in ("ms", "mib", "macs")] == ["", "", ""]


@pytest.mark.slow
def test_a_sweep_measures_what_its_methods_cost(tmp_path, monkeypatch, configs, capsys):
    monkeypatch.setattr(sys, "argv", ["lightning"])

    def here(folders, jobs, every):
        for folder in folders:
            worker.train_and_test(folder, every)
            yield {folder: None}

    monkeypatch.setitem(cli._ENGINES, "local", here)
    for name, text in (
        ("vidarsr", "{class_path: VidarSR, init_args: {width: 4, features: 2}}"),
        ("t", "{init_args: {width: 4, representation_width: 4, features: 1, stages: 1, blocks: 1, end_blocks: 1}}"),
    ):
        (tmp_path / f"{name}.yaml").write_text(f"model: {{network: {text}}}")
    (tmp_path / "small.yaml").write_text(
        "data: {init_args: {patch: 8, val_patch: 12, train_clips: 4, val_clips: 2, batch_size: 2, workers: 0}}\n"
        "trainer: {check_val_every_n_epoch: 1, log_every_n_steps: 2}\n"
    )
    over = [str(tmp_path / f"{name}.yaml") for name in ("vidarsr", "t")]
    command = ["sweep", str(configs / "x2.yaml"), "-c", str(tmp_path / "small.yaml"), "--over", *over, "--steps", "2"]
    main([*command, "-o", str(tmp_path / "sweep")])
    table = cells((tmp_path / "sweep" / "sweep.md").read_text())
    assert table["vidarsr"]["method"] == "VidarSR"
    assert table["vidarsr"]["paper - CSCSR"] == "-2.58"
    for row in table.values():
        assert float(row["ms a frame"].replace(",", "")) > 0
        assert float(row["MiB"].replace(",", "")) >= 0

    def once(*_):
        raise AssertionError("measured again")

    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        VidarSR(2, width=4, features=2)(torch.zeros(1, 41, 12, 12), static=True)
    macs = float(table["vidarsr"]["MAC a pixel"].replace(",", ""))
    assert macs == pytest.approx(counter.get_total_flops() / 2 / 144, rel=0.01)  # the estimate of motion has a few
    monkeypatch.setattr(cost, "measure_costs", once)
    main([*command, "-o", str(tmp_path / "sweep")])  # all finished, nothing measured again
    assert cells((tmp_path / "sweep" / "sweep.md").read_text()) == table
