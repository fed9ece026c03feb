import pytest
import torch

from asca_pillars.models.map_backbone import as_map


@pytest.mark.parametrize(("capability", "copied"), [("AVX2", True), ("AVX512", False), ("DEFAULT", False)])
def test_a_map_has_its_channels_first_and_is_copied_where_gradients_are_slow_otherwise(
    capability: str, copied: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)
    cells = torch.arange(2 * 3 * 4 * 5.0).view(2, 3, 4, 5)

    found = as_map(cells)

    assert found.shape == (2, 5, 3, 4)
    assert torch.equal(found[1, :, 2, 3], cells[1, 2, 3])
    assert found.is_contiguous() == copied
