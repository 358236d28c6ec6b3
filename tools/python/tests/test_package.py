"""The package around the library: types, command line, README."""

import ast
import inspect
import re
import subprocess
import sys
from pathlib import Path

import splat4d
from splat4d import _splat4d

HERE = Path(__file__).parent


def test_the_types_name_what_there_is():
    stub = Path(splat4d.__file__).with_name("_splat4d.pyi").read_text()
    classes = {
        node.name: {item.name for item in node.body if isinstance(item, ast.FunctionDef)}
        for node in ast.parse(stub).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    }
    assert set(classes) == set(splat4d.__all__)
    for name, typed in classes.items():
        found = {m for m in vars(getattr(_splat4d, name)) if not m.startswith("_")}
        assert {m for m in typed if not m.startswith("_")} == found, name
    assert Path(splat4d.__file__).with_name("py.typed").is_file()


def test_everything_has_a_docstring():
    for name in splat4d.__all__:
        value = getattr(splat4d, name)
        assert inspect.getdoc(value), name
        for member, of in vars(value).items():
            if not member.startswith("_"):
                assert inspect.getdoc(of), f"{name}.{member}"


def run(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "splat4d", *arguments], capture_output=True, text=True
    )


def test_the_command_line_is_there():
    version = run("--version")
    assert version.returncode == 0 and re.fullmatch(r"splat4d \d+\.\d+\.\d+\n", version.stdout)
    wrong = run("no-such-command")
    assert wrong.returncode == 2 and "no-such-command" in wrong.stderr


def test_the_quick_start_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (HERE.parent / "README.md").read_text(), re.DOTALL)
    assert len(blocks) >= 2
    names = {}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), names)
    assert (tmp_path / "trained.safetensors").is_file()
