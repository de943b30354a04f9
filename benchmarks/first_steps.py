"""Cost of first steps beside a bare `import torch`: opening a model, help, errors, a first motion.

    python benchmarks/first_steps.py

Prints user CPU seconds, the median of three processes each, and their ratios to `import torch` of the same
run; the modules of ours that opening a model imports; and the files of ours whose functions opening a model,
generating, captioning and editing enter, counted by `sys.setprofile`.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

TIMES = 3
OPEN = "from motionloom import MotionModel; MotionModel.from_pretrained('synthetic', device='cpu')"
MOTION = "; MotionModel('synthetic', 'cpu').generate(['a person waves'], seed=1)[0]"
RUN = (
    "from motionloom.pipeline.cli.main import main; import sys; sys.argv = ['motionloom', *{words!r}]; main()"
)
COUNTED = """
import sys
{program}
print(sum(name.partition('.')[0] == 'motionloom' for name in sys.modules))
"""
PROFILED = """
import os, sys, warnings
from pathlib import Path
import motionloom
from motionloom import MotionModel
from motionloom.pipeline.curation.captioning import captions
warnings.simplefilter('ignore')
root, entered = str(Path(motionloom.__file__).resolve().parent) + os.sep, set()
def enter(frame, event, _):
    if event == 'call' and frame.f_code.co_filename.startswith(root):
        entered.add(frame.f_code.co_filename)
model, editor, clip = MotionModel('synthetic', 'cpu'), MotionModel('inbetween', 'cpu'), sys.argv[1]
task = {'keep': [{'end': 0.6}, {'start': 1.2}]}
model.generate(['a person waves'], seed=1)[0].save(clip)
calls = {
    'open': lambda: MotionModel('synthetic', 'cpu'),
    'generate': lambda: model.generate(['a person waves'], seed=1),
    'caption': lambda: list(captions(model, [clip])),
    'edit': lambda: editor.edit(clip, task),
}
for name, call in calls.items():
    call()  # what is imported, each module once, is in then
    entered.clear()
    sys.setprofile(enter)
    call()
    sys.setprofile(None)
    print(f'files of ours entered by {name}: {len(entered)}')
"""


def seconds(program: str) -> float:
    """User CPU seconds of a process that runs a program, the median of three."""
    found = []
    for _ in range(TIMES):
        before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        subprocess.run([sys.executable, "-P", "-c", program], capture_output=True, check=False)
        found.append(resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before)
    return median(found)


def said(program: str, *words: str) -> str:
    """Return the standard output of a program."""
    words = (sys.executable, "-P", "-c", program, *words)
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout


def modules_to_open() -> int:
    """Modules of ours that opening a model of the package imports."""
    return int(said(COUNTED.format(program=OPEN)))


def main() -> None:
    programs = {
        "import torch": "import torch",
        "open a model": OPEN,
        "first motion": f"from motionloom import MotionModel{MOTION}",
        "motionloom --help": RUN.format(words=["--help"]),
        "motionloom run nosuch": RUN.format(words=["run", "nosuch"]),
        "a --set of no stage": RUN.format(words=["run", "humantomato-tiny", "--set", "nosuch.x=1"]),
        "a --set of no key": RUN.format(words=["run", "humantomato-tiny", "--set", "gpt.nosuch=1"]),
    }
    found = {name: seconds(program) for name, program in programs.items()}
    for name, took in found.items():
        print(f"{name:24} {took:5.2f} CPU s  {took / found['import torch']:5.2f}")
    print(f"modules of ours to open a model: {modules_to_open()}")
    with tempfile.TemporaryDirectory() as folder:
        print(said(PROFILED, str(Path(folder) / "waves.bvh")), end="")


if __name__ == "__main__":
    main()
