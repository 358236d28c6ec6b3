"""The command-line program that the package contains, and its commands as functions.

Each job runs in a separate process. Its results are bitwise those of the command line, other Python
threads keep running, and a crash does not affect the Python process.
"""

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

from ._splat4d import Error

PROGRAM = Path(__file__).parent / "bin" / ("splat4d.exe" if os.name == "nt" else "splat4d")
# The program's exit code after Ctrl-C.
_STOPPED = 130


def missing():
    """An error message if the package was built without the program, else `None`."""
    return None if PROGRAM.is_file() else f"{PROGRAM} is missing: the package was built without it"


def _words(options):
    """Options as command-line arguments: `max_frames=5` becomes `--max-frames=5`, True becomes a flag; None and
    False are left out."""
    for name, value in options.items():
        option = "--" + name.replace("_", "-")
        if value is None or value is False:
            continue
        if value is True:
            yield option
            continue
        several = isinstance(value, (list, tuple))
        yield f"{option}={','.join(map(str, value)) if several else value}"


def command(name, *arguments, progress=None, **options):
    """Runs a command of the program, waits for it, and returns its result: the output of `--json`, as a
    dict. `python -m splat4d NAME --help` lists the arguments, the options and the keys.

    An option `max_frames=5` becomes `--max-frames=5`; True becomes a flag, a list or tuple is joined by
    commas, None and False are left out. `progress` is called with each line of text that the program writes
    while it runs; without `progress` the lines go to standard error.

    Ctrl-C stops the program and raises `KeyboardInterrupt`. A command that writes checkpoints writes one
    first: `resume=True` continues from it.

    Raises `splat4d.Error` with the program's message if the job fails or the arguments are wrong."""
    if missing():
        raise Error(missing())
    words = [str(PROGRAM), "--json", name, *_words(options), "--", *map(os.fspath, arguments)]
    job = subprocess.Popen(
        words,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE if progress else None,
        text=True,
        encoding="utf-8",
        # In a new session the program gets Ctrl-C once, from here: a second one would stop it immediately.
        start_new_session=os.name != "nt",
    )
    answer = []
    reader = threading.Thread(target=lambda: answer.append(job.stdout.read()))
    reader.start()
    try:
        for line in job.stderr if progress else ():
            progress(line.rstrip("\n"))
        job.wait()
    except BaseException:
        job.send_signal(signal.SIGINT if os.name != "nt" else signal.CTRL_C_EVENT)
        if progress:
            # Drains the pipe: the program would block on a full one.
            for line in job.stderr:
                pass
        job.wait()
        raise
    finally:
        reader.join()
        job.stdout.close()
        if progress:
            job.stderr.close()
    if job.returncode == _STOPPED:
        raise KeyboardInterrupt
    try:
        found = json.loads(answer[0])
    except ValueError:
        raise Error(f"splat4d {name} ended with {job.returncode} and gave no answer") from None
    if "error" in found:
        raise Error(found["error"])
    return found


def reconstruct(frames, output, *, progress=None, **options):
    """Reconstructs a scene from a video or a folder of frames without camera poses, and writes the scene file
    `output`. Returns the report as a dict. Options, progress, Ctrl-C and errors: `splat4d.command`."""
    return command("reconstruct", frames, output=output, progress=progress, **options)


def train(dataset, output, *, progress=None, **options):
    """Trains a scene on a dataset with known camera poses, and writes the scene file `output`. Returns the
    report as a dict. Options, progress, Ctrl-C and errors: `splat4d.command`."""
    return command("train", dataset, output=output, progress=progress, **options)


def track(frames, output, *, progress=None, **options):
    """Computes cameras, masks, depth and point tracks of a video or a folder of frames, and writes them into
    the folder `output`. Returns the report as a dict. Options, progress, Ctrl-C and errors: `splat4d.command`."""
    return command("track", frames, output=output, progress=progress, **options)


def evaluate(estimate, reference, *, progress=None, **options):
    """Evaluates a scene against images or ground truth, or a trajectory or point tracks against a reference.
    Returns the metrics as a dict. Options, progress, Ctrl-C and errors: `splat4d.command`."""
    return command("eval", estimate, reference, progress=progress, **options)


def synth(name, output, *, progress=None, **options):
    """Writes a synthetic clip with exact poses, depth, flow and masks into the folder `output`. Returns the
    report as a dict. Options, progress, Ctrl-C and errors: `splat4d.command`."""
    return command("synth", name, output=output, progress=progress, **options)


def main():
    """Runs the program with this process's arguments. Where it does not replace this process, returns its exit
    code."""
    if missing():
        print(f"error: {missing()}", file=sys.stderr)
        return 1
    words = [str(PROGRAM), *sys.argv[1:]]
    if os.name == "nt":
        return subprocess.call(words)
    # The program replaces this process, so it gets the signals and sets the exit code.
    os.execv(PROGRAM, words)
