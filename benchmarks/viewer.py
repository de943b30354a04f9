"""What the page's figure costs in a headless Chromium without a GPU: frames a second, processor time a frame.

python benchmarks/viewer.py --figures 1 4 8 --seconds 6

Each line is a page of so many moving figures in a window of one size, in the WebGL2 view (its pixels made by
SwiftShader, on the processor) or as sticks.

* Frames a second, of the page as it plays, depend on what else the machine does.
* Processor time a picture of all figures, over all of the browser's processes, hardly does: it is that of
  painting as fast as it goes, in the quality that the page had settled on, and takes in all that the figures
  cost, but not what the browser needs to put them on a screen. A machine keeps up with 60 frames a second
  where its cores together have as much, and the rest of the page's needs, to give in 16.7 ms.
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
from motionloom.pipeline.render.body.face import synthetic_face_controls
from motionloom.pipeline.render.viewer import ViewerMotion, write_viewer

FLAGS = ["--no-sandbox", "--disable-gpu", "--use-angle=swiftshader-webgl", "--enable-unsafe-swiftshader"]
"""As a browser without a GPU is: WebGL by SwiftShader, the page itself put together in plain software."""
SIZES = {"desktop": (1200, 800), "phone": (390, 844)}
WARM, PICTURES = 4, 40
"""Pictures that are painted before, and while time is taken."""
FRAMES = """(least) => new Promise((done) => {
    const from = __viewer.draws, start = performance.now();
    const look = () => {
        const passed = performance.now() - start, drawn = __viewer.draws - from;
        if (passed < 1000 * least || drawn < 4) return requestAnimationFrame(look);
        const { stage } = __viewer;
        done({ passed: passed / 1000, drawn, quality: stage ? stage.quality : null });
    };
    look();
})"""
PAINT = """([count, quality]) => {
    const { stage } = __viewer, canvases = [...document.querySelectorAll("canvas")];
    __viewer.play(true);
    for (let k = 0; k < count; k++) {
        __viewer.setFrame(k);
        if (stage) stage.quality = quality;
        __viewer.paint();
        // What is only painted over is never made of a plain picture; what WebGL is told, it does.
        if (stage && k < count - 1) continue;
        for (const canvas of canvases) canvas.getContext("2d").getImageData(0, 0, 1, 1);
    }
    __viewer.play(false);
}"""


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
    found, shown = page.evaluate(FRAMES, seconds), page.evaluate("__viewer.view")
    page.evaluate(PAINT, [WARM, found["quality"]])
    page.wait_for_timeout(500)
    before = processor_seconds(os.getpid())
    page.evaluate(PAINT, [PICTURES, found["quality"]])
    used = processor_seconds(os.getpid()) - before
    page.close()
    assert shown == view, f"the page shows {shown}"
    return {
        "fps": found["drawn"] / found["passed"],
        "cpu_ms": 1000 * used / PICTURES,
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
    print("figures  window   view   frames/s  processor ms a picture  quality")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        for count in args.figures:
            path = page_of(Path(folder) / f"{count}.html", count)
            for name in args.sizes:
                for view in args.views:
                    row = measure(browser, path, SIZES[name], view, args.seconds)
                    quality = "" if row["quality"] is None else row["quality"]
                    print(
                        f"{count:7}  {name:7}  {view:5}  {row['fps']:8.1f}  {row['cpu_ms']:22.1f}  {quality}",
                        flush=True,
                    )
        browser.close()


if __name__ == "__main__":
    main()
