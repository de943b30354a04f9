"""A conversion killed five times, then finished, writes the bytes of one that was left alone."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from bvh_clips import write_clip, write_map

# One process imports everything once and forks each try, so that a kill falls into the work and not into
# imports. A try is killed as soon as so many of its files (batches, shards) are finished, and a random moment
# later, the last one while a file is half written; never so late that it might have finished.
SCRIPT = """
import hashlib, json, os, random, signal, sys, time
from pathlib import Path
from motionloom.datasets.convert.bvh.convert import BvhConfig, prepare_bvh
from motionloom.datasets.convert.common.conversion import SCAN_FILE, run_conversion
from motionloom.datasets.shards.tasks import write_shard
import webdataset.writer

def convert(out):
    pid = os.fork()
    if not pid:
        try:
            os.setpgid(0, 0)
            run_conversion(prepare_bvh(config, scan=out / SCAN_FILE), out, progress=False, clips_per_shard=8)
        except BaseException:
            import traceback
            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    os.setpgid(pid, pid)  # by both: the group is there for whoever comes first, however late the other runs
    return pid

def finished(out):
    return len([p for pattern in (".work/*.json", "*.index.json") for p in out.glob(pattern)])

def digests(out):
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(out.iterdir())}

def running(pid):
    return os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None

def into_a_write(pid, out):
    # Stops the conversion where a file is half written, however slow or busy the machine is.
    while running(pid):
        if any(out.rglob("*.tmp")):
            os.killpg(pid, signal.SIGSTOP)
            os.waitpid(pid, os.WUNTRACED)
            if any(out.rglob("*.tmp")):
                return
            os.killpg(pid, signal.SIGCONT)
        time.sleep(0.0005)

source, work, chance = Path(sys.argv[1]), Path(sys.argv[2]), random.Random(int(sys.argv[3]))
config = BvhConfig(source=source / "clips", joint_map=source / "joint_map.json", licence="CC0")
whole, out = work / "whole", work / "out"
assert os.waitpid(convert(whole), 0)[1] == 0
total = len(list(whole.glob("*.index.json"))) + int(sys.argv[4])
moments = sorted(chance.sample(range(total - 6), 5))
kills = 0
for moment in moments:
    pid = convert(out)
    while finished(out) < moment and running(pid):
        time.sleep(0.001)
    if moment == moments[-1]:
        into_a_write(pid, out)
    else:
        time.sleep(chance.uniform(0, 0.015))
    os.killpg(pid, signal.SIGKILL)
    kills += os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == -signal.SIGKILL
    assert not (out / "manifest.json").exists()
left = [p.name for p in out.rglob("*.tmp")]
assert os.waitpid(convert(out), 0)[1] == 0
made = digests(out)
print(json.dumps({"kills": kills, "left": len(left), "equal": made == digests(whole), "files": len(made)}))
"""


def test_five_kills_change_no_byte(tmp_path: Path) -> None:
    source = tmp_path / "source"
    for number in range(80):
        write_clip(source / f"clips/{number:02d}.bvh", number, frames=60 + number)
    write_map(source / "joint_map.json")
    script = tmp_path / "kill.py"
    script.write_text(SCRIPT)
    command = [sys.executable, str(script), str(source), str(tmp_path), "0", "2"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["kills"] == 5 and found["equal"] and found["files"] > 20
    assert found["left"] > 0, "no kill fell into a write: the test has lost its point"
