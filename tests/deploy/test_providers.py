from pathlib import Path

import onnxruntime
import pytest

from asca_deploy import Detector, providers
from asca_deploy.providers import ProviderError, select_providers
from asca_pillars.errors import BundleError

CPU = "CPUExecutionProvider"
CUDA = "CUDAExecutionProvider"
TENSORRT = "TensorrtExecutionProvider"


@pytest.mark.parametrize(
    ("requested", "available", "selected"),
    [
        ("cpu", [CPU], ["cpu"]),
        ("cpu", [TENSORRT, CUDA, CPU], ["cpu"]),
        ("auto", [CPU], ["cpu"]),
        ("auto", [TENSORRT, CUDA, CPU], ["cuda", "cpu"]),
        ("auto", ["OpenVINOExecutionProvider", CPU], ["cpu"]),  # may compute in bf16: only on request
        ("cuda", [CUDA, CPU], ["cuda"]),
        ("tensorrt", [TENSORRT, CUDA, CPU], ["tensorrt"]),
        ("openvino", ["OpenVINOExecutionProvider", CPU], ["openvino"]),
        ("coreml", ["CoreMLExecutionProvider", CPU], ["coreml"]),
    ],
)
def test_selection(requested: str, available: list[str], selected: list[str]) -> None:
    assert select_providers(requested, available) == selected


@pytest.mark.parametrize(
    ("requested", "remedy"),
    [
        ("cuda", "onnxruntime-gpu"),
        ("tensorrt", "pip install tensorrt"),
        ("openvino", "OpenVINO"),
        ("coreml", "macOS"),
    ],
)
def test_a_missing_provider_says_what_to_install(requested: str, remedy: str) -> None:
    with pytest.raises(ProviderError, match=f"provider {requested} is not in this onnxruntime .*{remedy}") as caught:
        select_providers(requested, ["AzureExecutionProvider", CPU])
    assert "\n" not in str(caught.value)


def test_an_unknown_provider_names_the_known_ones() -> None:
    with pytest.raises(ProviderError, match=r"'gpu'; choose one of auto, cpu, cuda, tensorrt"):
        select_providers("gpu", [CUDA, CPU])


def test_the_detector_says_which_provider_auto_took(tiny_bundle: Path) -> None:
    assert Detector(tiny_bundle, provider="auto").provider in ("cpu", "cuda")


class StubSession:
    """Stands in for onnxruntime.InferenceSession: `starts` are the providers that come up."""

    def __init__(self, starts: list[str], fails: bool = False) -> None:
        self.starts, self.fails, self.opened = starts, fails, list[list[str]]()

    def __call__(
        self, path: str, options: object, providers: list[tuple[str, object]], enable_fallback: int
    ) -> "StubSession":
        assert not enable_fallback  # onnxruntime would print and go on with the CPU
        self.opened.append([name for name, _ in providers])
        if self.fails and providers[0][0] != CPU:
            raise RuntimeError("CUDA failure 100: no CUDA-capable device is detected\nand 20 lines more")
        return self

    def get_providers(self) -> list[str]:
        last = self.opened[-1]
        return [name for name in last if name in self.starts]


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
        providers.open_session(GRAPH, ["cuda"], threads=2)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("stub", [([CPU],), ([CPU], True)], indirect=True, ids=["silent", "loud"])
def test_auto_goes_on_to_the_next(stub: StubSession) -> None:
    assert providers.open_session(GRAPH, ["cuda", "cpu"], threads=2)[1] == "cpu"
    assert stub.opened == [[CUDA, CPU], [CPU]]


@pytest.mark.parametrize("stub", [([TENSORRT, CUDA, CPU],)], indirect=True)
def test_tensorrt_leaves_the_rest_to_cuda_before_the_cpu(stub: StubSession) -> None:
    assert providers.open_session(GRAPH, ["tensorrt"], threads=2)[1] == "tensorrt"
    assert stub.opened == [[TENSORRT, CUDA, CPU]]


def test_a_file_that_is_no_graph(tmp_path: Path) -> None:
    (tmp_path / "encoder.onnx").write_bytes(b"not protobuf")
    with pytest.raises(BundleError, match=r"cannot run .*encoder\.onnx") as caught:
        providers.open_session(tmp_path / "encoder.onnx", ["cpu"], threads=1)
    assert "\n" not in str(caught.value)
