"""Every launch of a kernel names its device: without one, Warp uses the first GPU of a computer that has one."""

import ast
import pathlib

ROOT = pathlib.Path(__file__).parents[2]


def unnamed_launches(code: str) -> list[int]:
    """Lines of the calls of ``wp.launch`` in a module that have neither a device nor ``**`` arguments."""
    return [
        node.lineno
        for node in ast.walk(ast.parse(code))
        if isinstance(node, ast.Call)
        and ast.unparse(node.func) == "wp.launch"
        and not {"device", None} & {keyword.arg for keyword in node.keywords}
    ]


def test_a_launch_without_a_device_is_found() -> None:
    assert unnamed_launches("wp.launch(f, 3)\nwp.launch(f, 3, device=d)\nwp.launch(f, 3, **given)") == [1]


def test_every_launch_names_its_device() -> None:
    modules = sorted((ROOT / "vinesim").rglob("*.py"))
    found = {str(path.relative_to(ROOT)): unnamed_launches(path.read_text(encoding="utf-8")) for path in modules}
    assert {name: lines for name, lines in found.items() if lines} == {}
