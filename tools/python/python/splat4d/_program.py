"""The program that lies in the package, and its commands as functions.

A job runs in a process of its own: it gives the same bits as on the command line, other threads of
Python go on, and a failure leaves Python alone.
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
# What the program ends with after Ctrl-C.
_STOPPED = 130


def missing():
    """What is wrong where the package was built without the program, else nothing."""
    return None if PROGRAM.is_file() else f"{PROGRAM} is missing: the package was built without it"


def _words(options):
    """Options as words: `max_frames=5` is `--max-frames=5`, True a flag; None and False are left out."""
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
    """Runs a command of the program, waits for it, and gives its answer: what `--json` prints, as a
    dict. `python -m splat4d NAME --help` has the arguments, the options and the keys.

    An option `max_frames=5` is `--max-frames 5`; True is a flag, a list or tuple is joined by commas, None and False
    are left out. `progress` is called with each line of text that the program writes while it
    works; without it they go to standard error.

    Ctrl-C stops the program, which puts away what it has (a checkpoint, where the command makes them:
    `resume=True` goes on from it), and raises `KeyboardInterrupt`.

    Raises `splat4d.Error` with the program's text where the job fails or the arguments are wrong."""
    if missing():
        raise Error(missing())
    words = [str(PROGRAM), "--json", name, *_words(options), "--", *map(os.fspath, arguments)]
    job = subprocess.Popen(
        words,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE if progress else None,
        text=True,
        encoding="utf-8",
        # Ctrl-C reaches it once, from here: a second one would stop it at once.
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
            # Otherwise it waits for room in the pipe.
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
    """From a video or a folder of frames, camera poses unknown, to a scene's file `output`. Gives the report as
    a dict. Options, progress, Ctrl-C and errors: `splat4d.command`."""
    return command("reconstruct", frames, output=output, progress=progress, **options)


def train(dataset, output, *, progress=None, **options):
    """From a dataset with known camera poses to a scene's file `output`. Gives the report as a dict.
    Options, progress, Ctrl-C and errors: `splat4d.command`."""
    return command("train", dataset, output=output, progress=progress, **options)


def track(frames, output, *, progress=None, **options):
    """Cameras, masks, depth and point tracks of a video or a folder of frames, into the folder `output`.
    Gives the report as a dict. Options, progress, Ctrl-C and errors: `splat4d.command`."""
    return command("track", frames, output=output, progress=progress, **options)


def evaluate(estimate, reference, *, progress=None, **options):
    """Measures a scene against pictures or truth, or a trajectory or point tracks against others. Gives
    the figures as a dict. Options, progress, Ctrl-C and errors: `splat4d.command`."""
    return command("eval", estimate, reference, progress=progress, **options)


def synth(name, output, *, progress=None, **options):
    """Makes a synthetic clip with exact poses, depth, flow and masks in the folder `output`. Gives the
    report as a dict. Options, progress, Ctrl-C and errors: `splat4d.command`."""
    return command("synth", name, output=output, progress=progress, **options)


def main():
    """Runs the program with this process's arguments; its exit code."""
    if missing():
        print(f"error: {missing()}", file=sys.stderr)
        return 1
    words = [str(PROGRAM), *sys.argv[1:]]
    if os.name == "nt":
        return subprocess.call(words)
    # The same process: signals and the exit code are the program's own.
    os.execv(PROGRAM, words)
