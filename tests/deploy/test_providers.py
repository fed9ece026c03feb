import importlib.util
from pathlib import Path
from typing import Any

import onnxruntime
import pytest

from asca_deploy import Detector, openvino_session, providers
from asca_deploy.providers import Precision, Provider, available, require
from asca_pillars.base.errors import BundleError, ProviderError

CPU = "CPUExecutionProvider"
CUDA = "CUDAExecutionProvider"
TENSORRT = "TensorrtExecutionProvider"


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """What onnxruntime has, whether OpenVINO is installed, and whether the CPU has bfloat16."""
    available, openvino, bfloat16 = request.param
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: [*available, "AzureExecutionProvider"])
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: object() if openvino else None)
    monkeypatch.setattr(openvino_session, "_has_bfloat16", lambda: bfloat16)
    monkeypatch.setattr(openvino_session, "_device_name", lambda: "Example 9000")
    monkeypatch.delenv("NVIDIA_TF32_OVERRIDE", raising=False)


BARE = ([CPU], False, False)
OLD_CPU = ([CPU], True, False)
GPU = ([TENSORRT, CUDA, CPU], True, True)


@pytest.mark.parametrize(
    ("machine", "found"),
    [
        (BARE, "cpu float32"),
        (OLD_CPU, "cpu float32, openvino float32"),
        (GPU, "cpu float32, cuda reduced, cuda float32, tensorrt reduced, openvino reduced, openvino float32"),
    ],
    indirect=["machine"],
)
@pytest.mark.usefixtures("machine")
def test_what_is_available(found: str) -> None:
    assert ", ".join(map(" ".join, available())) == found


@pytest.mark.parametrize(
    ("machine", "provider", "precision", "remedy"),
    [
        (BARE, "cuda", "float32", r"not in this onnxruntime .*which has cpu; .*onnxruntime-gpu"),
        (BARE, "tensorrt", "reduced", "pip install tensorrt"),
        (BARE, "openvino", "float32", r"provider openvino is not installed: `pip install .*\[openvino\]'`"),
        (BARE, "cpu", "reduced", r"cpu has no precision reduced.*provider openvino.*--int8"),
        (OLD_CPU, "openvino", "reduced", r"Example 9000.*bfloat16; choose float32"),
        (GPU, "tensorrt", "float32", "NVIDIA_TF32_OVERRIDE=0"),
        (GPU, "gpu", "float32", r"'gpu'; choose one of auto, cpu, cuda, tensorrt, openvino"),
        (GPU, "cuda", "half", r"'half'; choose float32 or reduced"),
    ],
    indirect=["machine"],
)
@pytest.mark.usefixtures("machine")
def test_what_cannot_be_had_says_what_to_do(provider: Any, precision: Any, remedy: str, tiny_bundle: Path) -> None:
    with pytest.raises(ProviderError, match=remedy) as caught:
        require(provider, precision)
    assert "\n" not in str(caught.value)
    with pytest.raises(ProviderError, match=remedy):
        Detector(tiny_bundle, provider=provider, precision=precision)


@pytest.mark.parametrize("machine", [GPU], indirect=True)
@pytest.mark.usefixtures("machine")
def test_tensorrt_in_float32_where_the_environment_forbids_tf32(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NVIDIA_TF32_OVERRIDE", "0")
    require("tensorrt", "float32")


@pytest.mark.parametrize(
    ("version", "is_right"),
    [
        *((old, False) for old in ("1.24.4", "0.99", "1.9.0", "unknown")),
        *((new, True) for new in ("1.25.0", "1.32.0.dev2")),
    ],
)
def test_an_onnxruntime_that_computes_wrong_results_is_refused(
    version: str, is_right: bool, tiny_bundle: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(onnxruntime, "__version__", version)
    if is_right:
        Detector(tiny_bundle)
        return
    with pytest.raises(ProviderError, match=rf"onnxruntime {version} .*pip install .*'onnxruntime>=1.25'") as caught:
        Detector(tiny_bundle)
    assert "\n" not in str(caught.value)


class StubSession:
    """Stands in for onnxruntime.InferenceSession: `starts` are the providers that come up."""

    def __init__(self, starts: list[str], fails: bool = False) -> None:
        self.starts, self.fails, self.opened = starts, fails, list[list[tuple[str, dict[str, str]]]]()

    def __call__(
        self,
        path: str,
        options: object,
        providers: list[tuple[str, dict[str, str]]],
        enable_fallback: int,
        disabled_optimizers: list[str],
    ) -> "StubSession":
        assert not enable_fallback  # onnxruntime would print and go on with the CPU
        assert "WeightBiasQuantization" in disabled_optimizers
        self.opened.append(providers)
        if self.fails and providers[0][0] != CPU:
            raise RuntimeError("CUDA failure 100: no CUDA-capable device is detected\nand 20 lines more")
        return self

    def get_providers(self) -> list[str]:
        return [name for name, _ in self.opened[-1] if name in self.starts]

    def get_inputs(self) -> list[object]:
        return []

    get_outputs = get_inputs

    def run(self) -> None:
        """Nothing runs here."""


@pytest.fixture
def stub(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> StubSession:
    stub = StubSession(*request.param)
    monkeypatch.setattr(onnxruntime, "InferenceSession", stub)
    monkeypatch.setattr(onnxruntime, "preload_dlls", lambda: None)
    return stub


GRAPH = Path("backbone.onnx")


@pytest.mark.parametrize("stub", [([CPU],), ([CPU], True)], indirect=True, ids=["silent", "loud"])
def test_a_provider_that_does_not_start_is_an_error(stub: StubSession) -> None:
    with pytest.raises(ProviderError, match=r"provider cuda .*NVIDIA GPU") as caught:
        providers.open_session(GRAPH, "cuda", "float32", threads=2)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("stub", [([TENSORRT, CUDA, CPU],)], indirect=True)
@pytest.mark.parametrize(
    ("provider", "precision", "chain"),
    [
        ("cpu", "float32", [(CPU, {})]),
        ("cuda", "float32", [(CUDA, {"use_tf32": "0"}), (CPU, {})]),
        ("cuda", "reduced", [(CUDA, {"use_tf32": "1"}), (CPU, {})]),
        ("tensorrt", "float32", [(TENSORRT, {}), (CUDA, {"use_tf32": "0"}), (CPU, {})]),
        ("tensorrt", "reduced", [(TENSORRT, {"trt_fp16_enable": "1"}), (CUDA, {"use_tf32": "1"}), (CPU, {})]),
    ],
)
def test_options_by_precision_and_who_takes_the_rest(
    stub: StubSession, provider: Provider, precision: Precision, chain: list[tuple[str, dict[str, str]]]
) -> None:
    providers.open_session(GRAPH, provider, precision, threads=2)
    assert stub.opened == [chain]


def test_a_file_that_is_no_graph(tmp_path: Path) -> None:
    (tmp_path / "encoder.onnx").write_bytes(b"not protobuf")
    with pytest.raises(BundleError, match=r"cannot run .*encoder\.onnx") as caught:
        providers.open_session(tmp_path / "encoder.onnx", "cpu", "float32", threads=1)
    assert "\n" not in str(caught.value)
