"""Training through the command line: files, refusals, resumption after a kill; and what uses the result."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from clips import write_clip
from commands import run_labelgen
from detector_shards import write_painted_shards

from detector.checkpoint import METADATA_KEY, load_model, read_checkpoint
from labelgen.geometry import Pair

pytestmark = pytest.mark.slow

pytest.importorskip("lightning")
Run = Callable[..., subprocess.CompletedProcess[str]]

REPOSITORY = Path(__file__).resolve().parents[3]
SETTINGS = ("--preset", "small", "--device", "cpu", "--batch", 2, "--epochs", 2, "--steps-per-epoch", 4)
ONE_THREAD = {"OMP_NUM_THREADS": "1"}


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """As many threads as the processes of the tests have: sums then have the same order."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_painted_shards(tmp_path_factory.mktemp("painted") / "train", 8)


@pytest.fixture(scope="module")
def other_pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_painted_shards(tmp_path_factory.mktemp("other") / "shards", 2, size_wh=(96, 160), pair=Pair.VP1_VP2)


@pytest.fixture(scope="module")
def trained(shards: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder, made by the command line."""
    out = tmp_path_factory.mktemp("run") / "run"
    result = run_train(shards, "--out", out, "--val", shards, *SETTINGS, "--json", out.parent / "train.json")
    assert result.returncode == 0, result.stderr
    return out


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "labelgen", *map(str, arguments)]


def run_train(*arguments: object) -> subprocess.CompletedProcess[str]:
    return run_labelgen("train", *arguments)


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(REPOSITORY), **ONE_THREAD}


def weights(path: Path) -> dict[str, Any]:
    state: dict[str, Any] = read_checkpoint(path)["state_dict"]
    return state


def test_what_a_run_leaves(trained: Path) -> None:
    assert (trained / "last.ckpt").is_file()
    assert (trained / "best.ckpt").is_file()
    assert len(list((trained / "pictures").glob("epoch-*.jpg"))) == 2
    assert list(trained.glob("tensorboard/version_0/events*"))
    assert list(trained.glob("csv/version_0/metrics.csv"))
    report = json.loads((trained.parent / "train.json").read_text())
    assert (report["steps"], report["epochs"], report["interrupted"]) == (8, 2, False)
    assert {"train/loss", "val/ap50"} <= set(report["metrics"])


def test_a_checkpoint_carries_its_metadata(trained: Path) -> None:
    data = torch.load(trained / "last.ckpt", weights_only=True)
    metadata = data[METADATA_KEY]
    assert (metadata["preset"], metadata["pair"], tuple(metadata["size_wh"])) == ("small", "VP2-VP3", (160, 96))
    assert metadata["producer"].startswith("labelgen ")
    assert metadata["labels"][0]["settings"] == [{"kind": "exact"}]
    assert metadata["training"]["seed"] == 0
    assert metadata["training"]["ignore_boxes"] is True
    model, loaded = load_model(trained / "last.ckpt")
    assert loaded.to_dict() == metadata
    assert not model.training


def test_a_killed_training_resumes_to_the_same_weights(shards: Path, tmp_path: Path) -> None:
    settings = (*SETTINGS, "--seed", 3, "--checkpoint-every", 1)
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    assert run_train(shards, "--out", whole, *settings).returncode == 0
    # Killed as soon as there is a checkpoint, whichever step that is.
    arguments = command("train", shards, "--out", broken, *settings)
    with subprocess.Popen(arguments, cwd=REPOSITORY, env=environment(), stderr=subprocess.DEVNULL) as process:
        while process.poll() is None and not (broken / "last.ckpt").exists():
            try:
                process.wait(timeout=0.01)
            except subprocess.TimeoutExpired:
                continue
        process.kill()
    before = read_checkpoint(broken / "last.ckpt")["global_step"]
    assert 0 < before < 8
    resumed = run_train(shards, "--out", broken, *settings, "--resume")
    assert resumed.returncode == 0, resumed.stderr
    a, b = weights(whole / "last.ckpt"), weights(broken / "last.ckpt")
    assert a.keys() == b.keys()
    assert all(torch.equal(a[key], b[key]) for key in a)


@pytest.mark.parametrize(
    ("options", "name"), [(("--batch", 4), "batch"), (("--no-ignore-boxes",), "ignore_boxes")], ids=lambda part: part[0]
)
def test_resuming_requires_the_same_settings(
    trained: Path, shards: Path, options: tuple[object, ...], name: str
) -> None:
    changed = run_train(shards, "--out", trained, *SETTINGS, *options, "--resume")
    assert changed.returncode == 2
    assert f"{name} differ from those the run was started with" in changed.stderr
    assert changed.stderr.strip().splitlines()[-1].startswith("labelgen: error:")


def test_a_run_is_not_overwritten_without_the_option(trained: Path, shards: Path) -> None:
    again = run_train(shards, "--out", trained, *SETTINGS)
    assert again.returncode == 2
    assert "--resume" in again.stderr
    assert "--overwrite" in again.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--preset", "paper-640x360"), "but VP2-VP3 640x360 is wanted"),
        (("--preset", "huge"), "--preset huge: unknown"),
        (("--weights", "missing.ckpt"), "weights missing.ckpt"),
        (("--resume",), "last.ckpt"),
    ],
)
def test_training_errors_are_one_line(
    shards: Path, tmp_path: Path, arguments: tuple[object, ...], message: str
) -> None:
    result = run_train(shards, "--out", tmp_path / "run", "--device", "cpu", *arguments)
    assert result.returncode == 2
    (line,) = [line for line in result.stderr.splitlines() if "labelgen: error" in line]
    assert message in line


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--device", "warp9"), "--device warp9: unknown; use one of auto, cpu, gpu, cuda, cuda:0, mps"),
        (("--device", "cuda:99"), "--device cuda:99: this machine"),
        (("--device", "cpu:0"), "--device cpu:0: unknown"),
        (("--device", "cpu", "--precision", "fp16"), "--precision fp16: unknown; use one of 32-true"),
        (("--device", "cpu", "--precision", "16-mixed"), "--precision 16-mixed: a CPU cannot train in it"),
        (("--device", "cpu", "--devices", "0"), "--devices 0: expected a number from 1"),
        (("--device", "cpu", "--devices", "many"), "--devices many: expected a number from 1"),
        (("--device", "cpu", "--devices", "1000000"), "--devices 1000000: expected a number from 1"),
        (("--device", "cpu", "--strategy", "deepspeed"), "--strategy deepspeed: not available here"),
        (("--device", "cpu", "--strategy", "warp"), "--strategy warp: not available here"),
        (("--device", "cpu", "--lr", "-1"), "--lr -1.0: expected a positive number"),
        (("--device", "cpu", "--lr", "0"), "--lr 0.0: expected a positive number"),
        (("--device", "cpu", "--lr", "nan"), "--lr nan: expected a positive number"),
        (("--device", "cpu", "--lr", "inf"), "--lr inf: expected a positive number"),
    ],
)
def test_a_machine_that_cannot_do_it_is_one_line(
    shards: Path, tmp_path: Path, arguments: tuple[object, ...], message: str
) -> None:
    result = run_train(shards, "--out", tmp_path / "run", *arguments)
    assert result.returncode == 2
    (line,) = result.stderr.splitlines()
    assert message in line
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", ["cuda", "gpu", "cuda:0", "mps"])
def test_a_gpu_that_is_not_there_has_the_same_message_everywhere(shards: Path, trained: Path, name: str) -> None:
    if torch.cuda.is_available() or torch.backends.mps.is_available():
        pytest.skip("this machine has a GPU")
    for arguments in (("train", shards, "--out", "x"), ("detect", trained / "last.ckpt", shards, "--out", "x")):
        done = run_labelgen(*arguments, "--device", name)
        assert done.returncode == 2
        assert f"--device {name}: this machine has no such GPU" in done.stderr
        assert len(done.stderr.splitlines()) == 1


def test_a_diverging_run_stops_and_keeps_the_last_finite_checkpoint(
    shards: Path, trained: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    settings = ("--preset", "small", "--device", "cpu", "--batch", 2, "--precision", "32-true", "--val", shards)
    result = run_train(shards, "--out", out, *settings, "--epochs", 9, "--steps-per-epoch", 40, "--lr", "1e30")
    assert result.returncode == 2
    (line,) = [line for line in result.stderr.splitlines() if "labelgen: error" in line]
    assert "training has diverged: " in line
    assert "is not finite after step" in line
    assert "--lr" in line
    for path in out.glob("*.ckpt"):
        assert all(value.isfinite().all() for value in weights(path).values())


@pytest.mark.parametrize("command_of", ["detect", "export-model", "test-detector", "resume", "weights", "speed"])
def test_weights_that_are_not_finite_are_refused(
    shards: Path, trained: Path, tmp_path: Path, command_of: str, labelgen: Run
) -> None:
    data = read_checkpoint(trained / "last.ckpt")
    next(value for value in data["state_dict"].values() if value.is_floating_point()).fill_(float("nan"))
    run = tmp_path / "run"
    run.mkdir()
    bad = run / "last.ckpt"
    torch.save(data, bad)
    clip = write_clip(tmp_path / "clip", 3)
    arguments: tuple[object, ...] = {
        "detect": ("detect", bad, shards, "--out", tmp_path / "d", "--device", "cpu"),
        "export-model": ("export-model", bad, "--out", tmp_path / "m.onnx"),
        "test-detector": ("test-detector", bad, shards, "--device", "cpu"),
        "resume": ("train", shards, "--out", run, "--val", shards, *SETTINGS, "--resume"),
        "weights": ("train", shards, "--out", tmp_path / "new", *SETTINGS, "--weights", bad),
        "speed": ("speed", clip, "--from", f"model:{bad}", "--device", "cpu", "--out", tmp_path / "s"),
    }[command_of]
    if command_of == "export-model":
        pytest.importorskip("onnxscript")
    done = labelgen(*arguments)
    assert done.returncode == 2
    (line,) = [line for line in done.stderr.splitlines() if "labelgen: error" in line]
    assert "not finite" in line, line
    assert "Traceback" not in done.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="needs signals")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_ends_training_with_a_summary_and_its_exit_code(
    shards: Path, tmp_path: Path, number: int, code: int
) -> None:
    out, report = tmp_path / "run", tmp_path / "report.json"
    settings = ("--preset", "small", "--device", "cpu", "--batch", 2, "--epochs", 500, "--checkpoint-every", 1)
    arguments = command("train", shards, "--out", out, *settings, "--json", report)
    with subprocess.Popen(
        arguments, cwd=REPOSITORY, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        while process.poll() is None and not (out / "last.ckpt").exists():
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=0.01)
        process.send_signal(number)
        printed, _ = process.communicate(timeout=120)
    assert process.returncode == code
    assert "interrupted; the same command with --resume goes on" in printed
    assert json.loads(report.read_text())["interrupted"] is True
    assert read_checkpoint(out / "last.ckpt")["global_step"] > 0


def test_checkpoints_are_written_in_the_run_folder_and_renamed(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder of temporary files that cannot be written does not matter."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    result = run_train(shards, "--out", tmp_path / "run", *SETTINGS)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "run" / "last.ckpt").is_file()
    assert not list((tmp_path / "run").glob(".labelgen-*"))


@pytest.mark.skipif(sys.platform == "win32", reason="needs limits of resources")
def test_a_full_disk_leaves_the_old_checkpoint(shards: Path, trained: Path, tmp_path: Path) -> None:
    """A limit of the size of files stands for the full disk."""
    run = tmp_path / "run"
    run.mkdir()
    (run / "last.ckpt").write_bytes((trained / "last.ckpt").read_bytes())
    before = (run / "last.ckpt").read_bytes()
    code = (
        "import resource, signal, sys\nfrom labelgen.cli.main import main\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000))\nmain(sys.argv[1:])\n"
    )
    arguments = [str(a) for a in ("train", shards, "--out", run, *SETTINGS, "--overwrite")]
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], cwd=REPOSITORY, env=environment(), capture_output=True, text=True,
        timeout=300,
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    assert "last.ckpt: file too large" in done.stderr
    assert (run / "last.ckpt").read_bytes() == before
    assert not list(run.glob(".labelgen-*"))


def test_evaluating_on_shards(labelgen: Run, trained: Path, shards: Path, other_pair: Path, tmp_path: Path) -> None:
    result = labelgen(
        "test-detector", trained / "last.ckpt", shards, "--device", "cpu", "--json", "out.json", **ONE_THREAD
    )
    assert result.returncode == 0, result.stderr
    report = json.loads((tmp_path / "out.json").read_text())
    assert report["images"] == 8
    assert {"ap", "ap50", "ap75", "cc_error", "ground_px", "ground_m", "invalid_share"} <= set(report)
    refused = labelgen("test-detector", trained / "last.ckpt", other_pair, **ONE_THREAD)
    assert refused.returncode == 2
    assert "VP1-VP2 96x160, but VP2-VP3 160x96 is wanted" in refused.stderr


def test_detecting_in_shards_and_videos(labelgen: Run, trained: Path, shards: Path, tmp_path: Path) -> None:
    result = labelgen(
        "detect",
        trained / "last.ckpt",
        shards,
        "--out",
        "a",
        "--score",
        0.0,
        "--render",
        "--device",
        "cpu",
        **ONE_THREAD,
    )
    assert result.returncode == 0, result.stderr
    lines = [json.loads(line) for line in (tmp_path / "a" / "detections.jsonl").read_text().splitlines()]
    assert [line["sample"] for line in lines[1:]] == list(range(8))
    assert len(list((tmp_path / "a" / "pictures").iterdir())) == 8
    clip = write_clip(tmp_path / "clip", 14, coco=False)
    result = labelgen(
        "detect",
        trained / "last.ckpt",
        clip,
        "--out",
        "b",
        "--score",
        0.01,
        "--limit",
        4,
        "--device",
        "cpu",
        **ONE_THREAD,
    )
    assert result.returncode == 0, result.stderr
    # What it wrote is what `labelgen speed` reads.
    from detector.speed.detection_file import DetectionFile

    file = DetectionFile.open(tmp_path / "b" / "detections.jsonl")
    assert file.rectification is not None
    assert file.rectification.size_wh == (160, 96)
    from clips import CAMERA

    assert [detections.frame for detections in file.frames(file.view(CAMERA))] == [0, 1, 2, 3]
    keys = labelgen(
        "detect", trained / "last.ckpt", clip, "--out", "k", "--score", 0.0, "--keyframes", "--device", "cpu",
        **ONE_THREAD,
    )  # fmt: skip
    assert keys.returncode == 0, keys.stderr
    lines = [json.loads(line) for line in (tmp_path / "k" / "detections.jsonl").read_text().splitlines()]
    assert [line["frame"] for line in lines[1:]] == [0, 12]
    none = labelgen(
        "detect", trained / "last.ckpt", clip, "--out", "c", "--score", 1.0, "--limit", 2, "--json", "c.json",
        "--device", "cpu", **ONE_THREAD,
    )  # fmt: skip
    assert none.returncode == 2
    assert "no vehicles found in clip.mp4: 0 detections of a score of at least 1 in 2 pictures" in none.stderr
    assert json.loads((tmp_path / "c.json").read_text())["detections"] == 0


@pytest.mark.parametrize("judged", [False, True])
def test_published_schedule_runs_with_and_without_validation(shards: Path, tmp_path: Path, judged: bool) -> None:
    from detector.model.retinanet import ModelConfig
    from detector.training.config import MachineConfig, find_preset
    from detector.training.train import train

    model = ModelConfig(backbone="resnet18", levels=(3, 4, 5, 6, 7), channels=32, head_convs=1)
    preset = replace(
        find_preset("paper-640x360", epochs=2, steps_per_epoch=1, batch=1, weights="none", patience=1),
        pair=None, size_wh=None, model=model,
    )  # fmt: skip
    summary = train(
        [shards], preset, tmp_path / "run", validation=[shards] if judged else [],
        machine=MachineConfig(accelerator="cpu", checkpoint_every=0, progress=False),
    )  # fmt: skip
    assert summary.steps == 2
    assert (summary.best is not None) == judged
    assert load_model(summary.checkpoint)[1].training["schedule"] == "plateau"


@pytest.mark.slow
def test_overfits_sixteen_samples(tmp_path: Path) -> None:
    from detector.data.augment import AugmentationRanges
    from detector.training.config import MachineConfig, find_preset
    from detector.training.train import train

    shards = write_painted_shards(tmp_path / "shards", 16)
    preset = find_preset("small", epochs=1, steps_per_epoch=100, batch=8, whole=AugmentationRanges())
    summary = train(
        [shards], preset, tmp_path / "run", validation=[shards],
        machine=MachineConfig(accelerator="cpu", checkpoint_every=0, progress=False),
    )  # fmt: skip
    assert summary.metrics["val/ap50"] > 0.99
    assert summary.metrics["val/cc_error"] < 0.01


@pytest.mark.slow
def test_exported_model_is_the_same(labelgen: Run, trained: Path, shards: Path, tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    result = labelgen(
        "export-model", trained / "last.ckpt", "--format", "onnx", "--out", "model.onnx", "--score", 0.005,
        "--check", shards, "--json", "out.json", **ONE_THREAD,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    parity = json.loads((tmp_path / "out.json").read_text())["parity"]
    assert parity["boxes"] > 100
    assert max(parity["px"], parity["cc"], parity["score"]) < 1e-4


def test_speeds_from_a_checkpoint(labelgen: Run, trained: Path, tmp_path: Path) -> None:
    clip = write_clip(tmp_path, 4, coco=False)
    model = f"model:{trained / 'last.ckpt'}"
    options = ("--score", 0.0, "--device", "cpu", "--out", "speeds", "--json", "out.json")
    result = labelgen("speed", clip, "--from", model, *options, **ONE_THREAD)
    # Four frames are too few for a track.
    assert result.returncode == 2
    assert "no vehicles found in clip: " in result.stderr
    assert json.loads((tmp_path / "out.json").read_text())["frames"] == 4
    result = labelgen("speed", clip, "--from", model, "--pair", "VP1-VP2", "--overwrite", *options, **ONE_THREAD)
    assert result.returncode == 2
    assert "leave out --pair and --size" in result.stderr
