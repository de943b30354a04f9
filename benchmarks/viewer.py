"""What the page's figure costs in a headless Chromium without a GPU: frames a second, processor time a frame.

python benchmarks/viewer.py --figures 1 4 8 --seconds 6

Each line is a page of so many moving figures in a window of one size, in the WebGL2 view (its pixels made
by SwiftShader, on the processor) or the flat one. Frames a second depend on what else the machine does.
Processor time a frame, summed over all processes of the browser, hardly does: a view keeps up with 60 frames
a second on a machine that has as much to give in 16.7 ms, over all cores that the browser may use.
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

from motionloom.datasets.motion.skeleton import Skeleton
from motionloom.datasets.synth.generate import SynthConfig, make_clip
from motionloom.pipeline.render.face import synthetic_face_controls
from motionloom.pipeline.render.viewer import ViewerMotion, write_viewer

FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
SIZES = {"desktop": (1200, 800), "phone": (390, 844)}
FRAMES = """(least) => new Promise((done) => {
    const from = __viewer.draws, start = performance.now();
    const look = () => {
        const passed = performance.now() - start, drawn = __viewer.draws - from;
        if (passed < 1000 * least || drawn < 12) return requestAnimationFrame(look);
        const { pace, stage } = __viewer;
        const [spent, quality] = stage ? [pace.spent, stage.quality] : [null, null];
        done({ passed: passed / 1000, drawn, spent, quality });
    };
    look();
})"""


def page_of(path: Path, figures: int) -> Path:
    """A page of so many synthetic clips, with faces."""
    config = SynthConfig(seed=7)
    parents = Skeleton.named("smplx52").parents
    motions = []
    for index in range(figures):
        clip = make_clip(index, config)
        face = None if clip.face is None else synthetic_face_controls(clip.face)
        fps = config.motion_layout.fps
        motions.append(ViewerMotion(clip.joints, fps, parents, "synthetic", clip.texts[0], "", face))
    write_viewer(path, motions, f"{figures} figures")
    return path


def processor_seconds(root: int) -> float:
    """User and system time of a process and all below it."""
    children: dict[int, list[int]] = {}
    times: dict[int, float] = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            fields = (entry / "stat").read_text().rsplit(")", 1)[1].split()
        except OSError:
            continue  # it has ended since
        children.setdefault(int(fields[1]), []).append(int(entry.name))
        times[int(entry.name)] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    total, waiting = 0.0, [root]
    while waiting:
        process = waiting.pop()
        total += times.get(process, 0.0)
        waiting += children.get(process, [])
    return total


def measure(
    browser: Any, page_file: Path, size: tuple[int, int], view: str, seconds: float
) -> dict[str, Any]:
    """One line of the table."""
    page = browser.new_page(viewport={"width": size[0], "height": size[1]})
    page.goto(page_file.as_uri() + ("?view=2d" if view == "2d" else ""))
    page.evaluate(FRAMES, seconds / 2)  # the quality settles
    before = processor_seconds(os.getpid())
    found = page.evaluate(FRAMES, seconds)
    used = processor_seconds(os.getpid()) - before
    shown = page.evaluate("__viewer.view")
    page.close()
    assert shown == view, f"the page shows {shown}"
    return {
        "fps": found["drawn"] / found["passed"],
        "cpu_ms": 1000 * used / found["drawn"],
        "script_ms": found["spent"],
        "quality": found["quality"],
    }


def main() -> None:
    """Read the command line and print the table."""
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description="What the page's figure costs in a browser without a GPU.")
    parser.add_argument("--figures", type=int, nargs="+", default=[1, 4, 8])
    parser.add_argument("--sizes", nargs="+", choices=list(SIZES), default=list(SIZES))
    parser.add_argument("--views", nargs="+", choices=["webgl", "2d"], default=["webgl", "2d"])
    parser.add_argument("--seconds", type=float, default=6.0)
    args = parser.parse_args()
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        raise SystemExit("no Chromium on this machine")
    print("figures  window   view   frames/s  processor ms a frame  script ms  quality")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        for count in args.figures:
            path = page_of(Path(folder) / f"{count}.html", count)
            for name in args.sizes:
                for view in args.views:
                    row = measure(browser, path, SIZES[name], view, args.seconds)
                    script = "" if row["script_ms"] is None else f"{row['script_ms']:.1f}"
                    quality = "" if row["quality"] is None else row["quality"]
                    print(
                        f"{count:7}  {name:7}  {view:5}  {row['fps']:8.1f}  {row['cpu_ms']:20.1f}"
                        f"  {script:>9}  {quality:>7}",
                        flush=True,
                    )
        browser.close()


if __name__ == "__main__":
    main()
