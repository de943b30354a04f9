"""Compare what joints show with what was asked for: the action first, then its attributes.

A request is a truth record (`ClipMeta.truth`) of which only what was asked for is filled in. The rules are
those of the synthetic source's actions, so only models of such clips are judged by them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.actions.dances import Record
from motionloom.datasets.actions.measure import agrees, described

_NOUNS = {"lie": "lying down", "sit": "sitting"}


def actions_of(truth: Record | None) -> tuple[str, ...]:
    """Return the actions of a truth record in their order; none where it states none."""
    if truth is None or "action" not in truth:
        return ()
    return tuple(part["action"] for part in truth.get("parts") or [truth])


def find_mismatch(requests: Sequence[Record], joints: NDArray[np.floating], fps: float) -> str | None:
    """Return in words what joints [T, N >= 22, 3], T >= 4, do not show of a request; None where all is shown.

    Of several requests, which a caption may mean, one has to be shown.
    """
    shown = [request for request in requests if _shows_actions(request, joints, fps)]
    if not shown:
        wanted = (" and then ".join(_NOUNS.get(act, act) for act in actions_of(one)) for one in requests)
        return f"the motion shows no {' nor '.join(wanted)}"
    if len(actions_of(shown[0])) > 1:
        return None  # which part of two shows a side or a count is not known
    seen = described(joints, fps, shown[0]["action"])
    for name, wanted in shown[0].items():
        if name != "action" and seen.get(name) != wanted:
            return f"the {name} is {seen.get(name) or 'another'}, not {wanted}"
    return None


def _shows_actions(request: Record, joints: NDArray[np.floating], fps: float) -> bool:
    """Whether joints show the actions of a request, whatever its attributes are."""
    bare = {"action": request["action"]}
    if request.get("parts"):
        bare["parts"] = [{"action": part["action"]} for part in request["parts"]]
    return agrees(bare, joints, None, fps)["action"]
