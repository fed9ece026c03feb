"""`train.precision`: what it means on machines with and without bfloat16."""

from pathlib import Path

import pytest
import torch

from asca_pillars.config.tree import Precision, load_config
from asca_pillars.training import module as bfloat16
from asca_pillars.training.loop import train
from asca_pillars.training.module import has_bfloat16, resolve_precision
from tests.helpers.scenes import write_dataset
from tests.helpers.shipped_configs import CONFIGS
from tests.helpers.tiny_run import with_train


@pytest.mark.parametrize(
    ("precision", "with_it", "without"), [("auto", "bf16", "fp32"), ("bf16", "bf16", "bf16"), ("fp32", "fp32", "fp32")]
)
def test_auto_follows_the_device(
    precision: Precision, with_it: Precision, without: Precision, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bfloat16, "has_bfloat16", lambda device: True)
    assert resolve_precision(precision) == with_it
    monkeypatch.setattr(bfloat16, "has_bfloat16", lambda device: False)
    assert resolve_precision(precision) == without


def test_a_gpu_answers_for_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    of_the_cpu = has_bfloat16("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    for native in (True, False):
        monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation, native=native: native)
        assert has_bfloat16() is has_bfloat16("cuda") is native
        assert has_bfloat16("cpu") is of_the_cpu


@pytest.mark.skipif(not Path("/proc/cpuinfo").is_file(), reason="needs Linux to say what the CPU has")
def test_a_cpu_with_avx512_bf16_or_amx_has_it_and_one_without_avx512_has_not() -> None:
    flags = set(Path("/proc/cpuinfo").read_text().split())
    if flags & {"avx512_bf16", "amx_bf16"}:
        assert has_bfloat16()
    elif "avx2" in flags and not flags & {"avx512f", "avx_ne_convert"}:
        assert not has_bfloat16()


def test_bf16_where_there_is_none_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("asca_pillars.training.loop.has_bfloat16", lambda: False)
    train(with_train(epochs=1, precision="bf16"), write_dataset(tmp_path / "data", 3), tmp_path / "run")
    assert "train.precision = bf16: this device has no bfloat16" in " ".join(capsys.readouterr().out.split())


def test_a_run_goes_on_in_the_precision_it_was_started_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data, run, path = write_dataset(tmp_path / "data", 3), tmp_path / "run", tmp_path / "run" / "config.yaml"
    for epochs, has_it, resolved in ((1, False, "fp32"), (2, True, "fp32"), (3, True, "bf16")):
        monkeypatch.setattr(bfloat16, "has_bfloat16", lambda device, has_it=has_it: has_it)
        if epochs == 3:  # an older version did not record it
            path.write_text(path.read_text().replace("precision: fp32", "precision: auto"))
        train(with_train(epochs=epochs, precision="auto"), data, run)
        assert load_config(path).train.precision == resolved


def test_configurations_that_ship_run_anywhere() -> None:
    assert len(CONFIGS) > 5
    for path in CONFIGS:
        assert load_config(path).train.precision in ("auto", "fp32"), f"{path}: slow where there is no bfloat16"
