"""`asca inspect --propose`: a configuration measured on the labels, printed and written as YAML."""

from pathlib import Path

import yaml
from rich.console import Console

from asca_pillars.base.errors import OutputError
from asca_pillars.base.files import write_text
from asca_pillars.config.tree import Config
from asca_pillars.data.inspection.findings import FEWEST_BOXES
from asca_pillars.data.inspection.proposal import differences, propose
from asca_pillars.data.labeled_split import LabeledSplit


def propose_config(split: LabeledSplit, config: Config, path: Path, frames: int, console: Console) -> Config:
    """Measure, write to `path`, print; gives the configuration that was written.

    Raises:
        DatasetError: as `propose`.
        OutputError: there is a file already.
    """
    if path.exists():
        raise OutputError(f"{path}: is there already and may have been edited; choose another name, or remove it")
    proposal = propose(split, config, frames=frames, progress=True)
    boxes = ", ".join(f"{name} {count}" for name, count in proposal.boxes.items())
    notes = [f"Measured on {split.root}, {split.name}: {boxes} boxes."]
    if proposal.rare:
        rare = ", ".join(f"{name} {count}" for name, count in proposal.rare.items())
        notes.append(f"No classes, for fewer than {FEWEST_BOXES} boxes with points: {rare}.")
    text = "".join(f"# {note}\n" for note in notes) + yaml.safe_dump(differences(proposal.config), sort_keys=False)
    write_text(path, text)
    console.print(text, soft_wrap=True)
    console.print(f"Written to {path}. Next: asca train {path} --data {split.root} --out runs/own", soft_wrap=True)
    return proposal.config
