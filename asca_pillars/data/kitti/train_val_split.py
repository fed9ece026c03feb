"""KITTI's 7,481 labelled frames in the two lists that papers train and validate on: 3,712 and 3,769.

The download has no lists. The division is that of Chen et al., "3D Object Proposals for Accurate Object Class
Detection" (NIPS 2015), which keeps frames of one drive on one side; detection toolboxes such as OpenPCDet carry it as
ImageSets/train.txt and val.txt.
"""

import base64
from pathlib import Path

import numpy as np

from asca_pillars.base.errors import DatasetError, OutputError
from asca_pillars.data.kitti.kitti_split import write_image_set
from asca_pillars.scans.find_scans import visible_files

FRAMES = 7481
_IN_TRAIN = (
    "k$&PPs$NsbpYgw$-AD1&bf)e$z8Lt#LZ;(hSi;-~^pQNLi@BmsCNgr2LK%|?mH>u0<>B*fK(6y3IiOBaYPMT=mdrFK`ta{Jz{eHF(q4z@+Q;QZ"
    "SMi!HGn7}jA<g}50Eceg`6d<Y`+&2#uWDmWN5peAq={-4{@g&xkLu0H-hkodJSj$nYM??P4bJlf;tcHh85Kf-prU{ew4{Cq+5dqp4JPaKF+%D7"
    "#%pe9iBH<v`8qzi=97?m9gAyHxh#NFN!lx_k80gj4ev*}sR$UHv+<a1(`8W4%NBW*Ht%&{NaJZRQ<ppbU?DJ{UVOKN8sZm0siVQc6&?13n5ppQ"
    "EhbI{{yZrgtf#jezDF}2=}eX1azwz!Mb3Ja69=-`msAco^X$Yk9$nm!|B&rgq#E`)1;W>H!xXX|+y(OMl%+B2I@^mm&~3;o5FWJyDI)Uz%abvL"
    "*Tl9kds@%nD}Zpe((_!sCa4AN4K|7(&+RA;%urd5mtI|H$yM~IITf~=)S&HJ#?2`bHeST9n`bX}Q57V^&zj6B@LKPmf`A99kx%X$dkEbI20UKs"
    "HV*D>7|&_+cmFaiP-qY8vdQA`#|QkTWbJ+r#HYuuiRYbCCH2M2zV&BW94W<#tH)*Ko|W~Jma$)T1`m736&o(<H(H9OQy{Pr2NdxE2Vno8=h&F="
    "S9*;MX8h?B2*Qe7q@EP9KSmk8HZg?!z!`{U)m6Dq2#I<2vOERx;<MZtS)%ms2Gv;=b_SP&K1d*kkbx1@gcml&8$9HCbjUflZtVxaW{<jJTr1f$"
    "B-lfgP5o+-gqK*WS5Z5V93==H*!r<Q5_&=_p@dXnFxb8MiOG`{u65>yR<{pgB#Rgrss3pui<tlO`uxb-q7%c85|q5(ywB@pRUTk@!!beU58DpB"
    "j8BtAb2Dnb#zPzOE@BSbOaHtLmni4K%ib^aFMG6#vEqmji0aQ{ZHt!K7t)Inen6CfRglEV=z0{*!HC;$R#&P!J&ncJTJ7UKbf4ad1zdlzpF@}7"
    "#4>|*2cwpU=#DlIf)U~UF$slh9*06RfVJ|aD;*fsBgf(16A`YCM@i7x@LKo|X`!1g1QJ7#no(q8P4hFRkW|$clCFZqo7-O;HHKGfk?C4#L~Otr"
    "&N6DER01y6`D$CjPaD~RH5BjM5>%_HEmZPRjtFK2<aq4Jk1QxYcdRfv;fjJ_U4mL0TtTS-"
)
"""A bit for each frame, first frame and highest bit first, in base85: 1 for the list `train`."""


def train_val_frames() -> dict[str, list[str]]:
    """The frame ids of the lists `train` and `val`, in ascending order."""
    in_train = np.unpackbits(np.frombuffer(base64.b85decode(_IN_TRAIN), np.uint8))[:FRAMES].astype(bool)
    lists = {"train": np.flatnonzero(in_train), "val": np.flatnonzero(~in_train)}
    return {name: [f"{number:06d}" for number in numbers] for name, numbers in lists.items()}


def write_train_val_lists(root: Path) -> list[Path]:
    """Write ImageSets/train.txt and val.txt of KITTI's frames below `root`; lists that are there already stay.

    Returns:
        The files that were written.

    Raises:
        DatasetError: training/velodyne does not hold KITTI's 7,481 scans.
        OutputError: a list with other frames is there.
    """
    lists = train_val_frames()
    scans = {path.stem for path in visible_files(root / "training" / "velodyne", "*.bin")}
    wanted = {frame_id for frame_ids in lists.values() for frame_id in frame_ids}
    if scans != wanted:
        raise DatasetError(
            f"{root / 'training' / 'velodyne'}: {len(wanted & scans)} of KITTI's {FRAMES} scans are there and "
            f"{len(scans - wanted)} others; KITTI's lists are for all of its scans and no others: leave --kitti-split "
            "out, and write lists of your own"
        )
    missing = []
    for name, frame_ids in lists.items():
        path = root / "ImageSets" / f"{name}.txt"
        if not path.exists():
            missing.append(path)
        elif path.read_text(encoding="utf-8", errors="replace").split() != frame_ids:
            raise OutputError(
                f"{path}: lists other frames than KITTI's split; move it away, or leave --kitti-split out"
            )
    for path in missing:
        write_image_set(root, path.stem, lists[path.stem])
    return missing
