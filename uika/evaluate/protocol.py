"""What is measured and how: the choices that two evaluations must share to be comparable."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass

TURNED_AWAY = 0.25  # cosine between face and camera below which a source would not show the face
VERSION = 3


@dataclass(frozen=True)
class Metric:
    """A column of the tables."""

    name: str
    higher: bool  # whether more is better
    digits: int
    cross: bool  # whether it means something when another person's face is the truth
    needs: str = ""  # the option without which it cannot be computed


METRICS = (
    Metric("PSNR", True, 2, False),
    Metric("SSIM", True, 3, False),
    Metric("FLIP", False, 3, False),
    Metric("LPIPS", False, 3, False, "lpips"),
    Metric("PSNR masked", True, 2, False),
    Metric("SSIM masked", True, 3, False),
    Metric("FLIP masked", False, 3, False),
    Metric("CSIM", True, 3, True, "arcface"),
    Metric("face distance", False, 3, True),
    Metric("AED", False, 4, True),
    Metric("APD", False, 4, True),
    Metric("AKD", False, 2, True),
)


@dataclass(frozen=True)
class Protocol:
    """The choices of one table; results with other ones are never mixed with it."""

    data: str  # name of the folder
    setting: str  # mono or multi
    task: str  # self or cross
    method: str  # name in the tables
    model: str  # what made the pictures
    correspondence: str  # fit or exact; empty for another system's pictures
    head: str  # id of the head model
    size: int  # pixels of a side
    background: float  # grey level in [0,1]
    targets: int  # frames at most for each sequence
    lpips: str = ""  # digest of the weights, empty without
    arcface: str = ""

    @property
    def metrics(self) -> tuple[Metric, ...]:
        """The columns that mean something for the task."""
        return tuple(metric for metric in METRICS if metric.cross or self.task == "self")

    def available(self, metric: Metric) -> bool:
        """Whether the files that a metric needs were given."""
        return not metric.needs or bool(getattr(self, metric.needs))

    def digest(self) -> str:
        """A short fingerprint of all choices."""
        text = json.dumps({"version": VERSION, **asdict(self)}, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def sentences(self) -> list[str]:
        """The choices in words, to be printed with the numbers."""
        setting = {
            "mono": "source and target frames of one camera, the most frontal one",
            "multi": "source and target frames of all cameras that see the face at first",
        }[self.setting]
        task = {
            "self": "targets are held-out frames of the same person",
            "cross": "expression, pose and camera of the next person's held-out frames drive the head",
        }[self.task]
        how = {
            "fit": "sources are pictures with a matte, no more; head and cameras are fitted to detected landmarks",
            "exact": "sources come with their true head parameters and cameras",
            "": "pictures of another system",
        }[self.correspondence]
        sentences = [
            f"data {self.data}: {setting}, sources turned to the camera; {task}; "
            f"at most {self.targets} targets for each sequence",
            f"{self.method}: {self.model}; {how}",
            "crop: the head's square where it takes less than three quarters of the frame, else the whole frame, "
            f"padded to a square; {self.size}x{self.size} pixels; "
            f"background: grey {self.background:g} in truth and result, cut out with the truth's mask",
            "values: sRGB in [0,1], both rounded to 8 bits; masked: pixels where the truth's mask is at least 0.5",
            "AED: mean difference of activations, APD: angle in radians between head rotations, both of head fits to "
            f"the detected landmarks (head model {self.head}); AKD: pixels at 512, 478 face mesh landmarks",
            "CSIM: " + ("against the truth" if self.task == "self" else "against the first source"),
            "face distance: between descriptors of dlib's free network, of the same pair; below 0.6 its author takes "
            "two pictures for one person; no CSIM, and not to be compared with any",
            "frames in which the detector finds no face in truth or result do not count for CSIM, face distance, AED, "
            "APD and AKD; "
            "the column 'faces' says how many did",
        ]
        if self.correspondence:
            sentences.append(
                "the camera takes up the rigid motion and scale between the true face and the avatar's, which pictures "
                "cannot tell apart"
            )
        return sentences
