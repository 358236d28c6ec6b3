"""The package around the library: types, command line, README."""

import ast
import inspect
import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import splat4d

HERE = Path(__file__).parent


def stub(module):
    return ast.parse(Path(splat4d.__file__).with_name(f"{module}.pyi").read_text()).body


def test_the_types_name_what_there_is():
    modules = ("_splat4d", "_gradients", "_page", "_program", "_rasterization")
    nodes = [node for module in modules for node in stub(module)]
    classes = {
        node.name: {
            item.target.id if isinstance(item, ast.AnnAssign) else item.name
            for item in node.body
            if isinstance(item, (ast.FunctionDef, ast.AnnAssign))
        }
        for node in nodes
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    }
    functions = {node.name: node for node in nodes if isinstance(node, ast.FunctionDef)}
    public = {name for name in functions if name in splat4d.__all__}
    assert {*public, *classes, "ops"} == set(splat4d.__all__)
    for name, typed in classes.items():
        of = getattr(splat4d, name)
        # Fields of a data class without defaults are annotations.
        there = {*vars(of), *getattr(of, "__annotations__", ())}
        found = {m for m in there if not m.startswith("_")}
        assert {m for m in typed if not m.startswith("_")} == found, name
    for name in sorted(public) + splat4d.ops.__all__:
        of = functions[name].args
        typed = [a.arg for a in of.args + ([of.vararg] if of.vararg else []) + of.kwonlyargs]
        typed += [of.kwarg.arg] if of.kwarg else []
        function = getattr(splat4d if name in public else splat4d.ops, name)
        assert typed == list(inspect.signature(function).parameters), name
    assert Path(splat4d.__file__).with_name("py.typed").is_file()


def test_everything_has_a_docstring():
    for module, name in [(m, name) for m in (splat4d, splat4d.ops) for name in m.__all__]:
        value = getattr(module, name)
        assert inspect.getdoc(value), name
        for member, of in vars(value).items() if inspect.isclass(value) else ():
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


def test_commands_are_functions(tmp_path):
    clip, tracked = tmp_path / "clip", tmp_path / "tracked"
    lines = []
    made = splat4d.synth("still", clip, frames=4, size="96x64")
    assert isinstance(made, dict) and len(list((clip / "frames").iterdir())) == 4
    report = splat4d.track(clip / "frames", tracked, device="software", progress=lines.append)
    assert report["frames"] == 4 and report["intrinsics"]["width"] == 96
    assert lines and all(isinstance(line, str) for line in lines)
    assert (tracked / "transforms.json").is_file()


def test_errors_of_commands_are_those_of_the_program(tmp_path):
    missing = tmp_path / "none.mp4"
    said = run("--json", "reconstruct", str(missing), "-o", str(tmp_path / "scene.safetensors"))
    with pytest.raises(splat4d.Error) as error:
        splat4d.reconstruct(missing, tmp_path / "scene.safetensors")
    assert str(error.value) == json.loads(said.stdout)["error"] and str(missing) in str(error.value)
    with pytest.raises(splat4d.Error, match="--no-such-option"):
        splat4d.evaluate("a.txt", "b.txt", no_such_option=True)
    with pytest.raises(splat4d.Error, match="--frames"):
        splat4d.synth("still", tmp_path / "clip", frames=-1)


def test_ctrl_c_stops_a_command(tmp_path, ctrl_c):
    clip = tmp_path / "clip"
    splat4d.synth("still", clip, frames=6, size="96x64")
    begin = time.perf_counter()

    def interrupt(line):
        signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        splat4d.reconstruct(
            clip / "frames", tmp_path / "scene.safetensors", device="software", steps=100000,
            progress=interrupt,
        )
    assert time.perf_counter() - begin < 30
    assert not (tmp_path / "scene.safetensors").exists()


def test_the_quick_start_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (HERE.parent / "README.md").read_text(), re.DOTALL)
    assert len(blocks) >= 2
    names = {}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), names)
    assert (tmp_path / "trained.safetensors").is_file()
