"""The examples: what they take from the package is there and, where PyTorch is installed, they run."""

import ast
import os
import re
import subprocess
import sys
from operator import attrgetter
from pathlib import Path

import pytest

import splat4d

HERE = Path(__file__).parent
EXAMPLES = sorted((HERE.parent / "examples").glob("*.py"))


def of_each(examples):
    return pytest.mark.parametrize("example", examples, ids=[path.stem for path in examples])


@pytest.fixture(scope="module")
def with_torch(tmp_path_factory):
    """Runs a program on its arguments with a Python that has PyTorch, this one or a `python3` of the path, and
    returns what it printed."""
    folders = os.environ.get("PATH", "").split(os.pathsep)
    for python in [sys.executable, *(os.path.join(folder, "python3") for folder in folders)]:
        probe = [python, "-c", "import numpy, torch"]
        if os.access(python, os.X_OK) and not subprocess.run(probe, capture_output=True).returncode:
            break
    else:
        pytest.skip("PyTorch: no python3 of the path has it (Debian: python3-torch); examples did not run")
    # The package alone, because what lies beside it may be for this Python.
    folder = tmp_path_factory.mktemp("package")
    (folder / "splat4d").symlink_to(Path(splat4d.__file__).parent)

    def run(*arguments):
        done = subprocess.run(
            [python, *map(str, arguments)], capture_output=True, text=True,
            env={**os.environ, "PYTHONPATH": str(folder)},
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


@of_each(EXAMPLES)
def test_what_an_example_takes_from_the_package_is_there(example):
    tree = ast.parse(example.read_text())
    uses = {ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    names = [match[1] for match in (re.fullmatch(r"splat4d\.([\w.]+)", use) for use in uses) if match]
    assert names
    for name in names:
        attrgetter(name)(splat4d)


@of_each(EXAMPLES)
def test_an_example_learns_its_target(example, with_torch):
    losses = [float(loss) for loss in re.findall(r"^step \d+: loss (\S+)$", with_torch(example), re.M)]
    assert len(losses) == 6 and losses[-1] < 0.2 * losses[0], losses


def test_gradients_of_the_renderer_pass_gradcheck(with_torch):
    assert "gradcheck passed" in with_torch(HERE / "gradcheck.py")
