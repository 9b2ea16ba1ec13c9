"""Structure of the package: no import cycles, unique names, a head in every module."""

import ast
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1] / "twin"
MODULES = {
    ".".join(path.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(ROOT.rglob("*.py"))
}

TEXTS = {module: path.read_text(encoding="utf-8") for module, path in MODULES.items()}
TREES = {module: ast.parse(text) for module, text in TEXTS.items()}


def _imports(module: str) -> set[str]:
    """Modules of the package that a module imports, also within functions."""
    out = set()
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            out |= {name if name in MODULES else node.module for name in names}
        elif isinstance(node, ast.Import):
            out |= {alias.name for alias in node.names}
    return (out & set(MODULES)) - {module}


def test_no_import_cycles():
    graph = {module: _imports(module) for module in MODULES}
    while leaves := [module for module, below in graph.items() if not below]:
        for leaf in leaves:
            del graph[leaf]
        for below in graph.values():
            below.difference_update(leaves)
    assert graph == {}, "these modules are in cycles, or above them"


def test_no_two_modules_share_a_name():
    places = defaultdict(list)
    for module, path in MODULES.items():
        if not path.stem.startswith("__"):
            places[path.stem].append(module)
    assert not [modules for modules in places.values() if len(modules) > 1]


def test_no_two_classes_share_a_name():
    places = defaultdict(list)
    for module, tree in TREES.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(module)
    assert not {name: modules for name, modules in places.items() if len(modules) > 1}


def test_every_module_has_a_head():
    """Empty modules, which only make a folder a package, need none."""
    assert not [module for module, text in TEXTS.items() if text and not ast.get_docstring(TREES[module])]
