"""What an evaluation keeps beside its figures, to be drawn: joints' errors, confusions, worst and best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from motionloom.datasets.motion.layout import MotionLayout
from motionloom.pipeline.evaluation.cases import Case, generated_cases, reconstructed_cases
from motionloom.pipeline.evaluation.confusions import measured_confusions, retrieval_confusions
from motionloom.pipeline.evaluation.joint_map import joint_map
from motionloom.pipeline.evaluation.text_motion import Latents, caption_distances
from motionloom.pipeline.evaluation.truth import Truth
from motionloom.pipeline.store.networks import TrainedTokenizer


@dataclass
class Details:
    """Gathered while figures are taken."""

    layout: MotionLayout
    version: int
    """Of the evaluating stage."""
    cases: list[Case] = field(default_factory=list)
    confusions: list[dict[str, Any]] = field(default_factory=list)
    joints: dict[str, Any] = field(default_factory=dict)

    def reconstructed(self, tokenizer: TrainedTokenizer, truths: Sequence[Truth]) -> None:
        """Each joint's error, and the worst and best clips."""
        found = joint_map(tokenizer, truths)
        self.joints = found.figures
        self.cases += reconstructed_cases(tokenizer, truths, found.clips)

    def judged(self, latents: Latents, truths: Sequence[Truth], joints: Sequence[NDArray[Any]]) -> None:
        """What captions are taken for, and the worst and best motions [T, N, 3] of the first repeat."""
        self.confusions += retrieval_confusions(latents, truths)
        far = caption_distances(latents.text, latents.made[0]).tolist()
        self.cases += generated_cases(truths, joints, far)

    def performed(self, truths: Sequence[Truth], joints: Sequence[NDArray[Any]]) -> None:
        """The actions that the motions of the first repeat show."""
        self.confusions += measured_confusions(truths, joints, self.layout.fps)

    def figures(self) -> dict[str, Any]:
        """What `metrics.json` gets."""
        out = {
            "version": self.version,
            "fps": self.layout.fps,
            "skeleton": self.layout.skeleton.name,
            **self.joints,
            "confusions": self.confusions,
        }
        return out | ({"cases": [case.figures() for case in self.cases]} if self.cases else {})
