"""Changed versions of the package's modules, for tools/mutation.py: mutmut's operators applied one place at a time.

Not changed: annotations, decorators, type aliases, docstrings, prose (strings with a space), log messages, imports,
`__all__`, and `strict=` of zip, which only asserts.
"""

import difflib
import hashlib
import random
import sys
from dataclasses import dataclass, field
from pathlib import Path

try:
    import libcst as cst
    from libcst.metadata import MetadataWrapper, PositionProvider
    from mutmut.mutation.mutators import mutation_operators
except ImportError:
    sys.exit('mutmut is not installed: pip install "mutmut>=3.8,<4"')


@dataclass(frozen=True)
class Mutant:
    """One changed line of a module; `source` is the whole changed module."""

    path: str
    line: int
    operator: str
    diff: str
    source: str = field(repr=False)

    @property
    def key(self) -> str:
        return hashlib.sha256(f"{self.path}\0{self.source}".encode()).hexdigest()[:16]


class _Collector(cst.CSTVisitor):
    """Collects (line, name of the operator, node, changed node) in `found`."""

    METADATA_DEPENDENCIES = (PositionProvider,)

    def __init__(self) -> None:
        self.found: list[tuple[int, str, cst.CSTNode, cst.CSTNode]] = []

    def on_visit(self, node: cst.CSTNode) -> bool:
        if _is_skipped(node):
            return False
        position = self.get_metadata(PositionProvider, node, None)
        for kind, operator in mutation_operators:
            if position is not None and isinstance(node, kind):
                name = operator.__name__.removeprefix("operator_")
                self.found += [
                    (position.start.line, name, node, changed)
                    for changed in operator(node)
                    if not (_only_strict_differs(node, changed))
                ]
        return True


def _only_strict_differs(node: cst.CSTNode, changed: cst.CSTNode) -> bool:
    if not (isinstance(node, cst.Call) and isinstance(changed, cst.Call)):
        return False
    before, after = ([a for a in call.args if not _is_skipped(a)] for call in (node, changed))
    return changed.func is node.func and before == after


def _is_skipped(node: cst.CSTNode) -> bool:
    match node:
        case cst.Annotation() | cst.Decorator() | cst.Import() | cst.ImportFrom() | cst.TypeAlias():
            return True
        case cst.SimpleString():
            return " " in node.value or node.value.startswith(('"""', "'''"))
        case cst.Call(func=cst.Attribute(value=cst.Name(value="_LOG"))):
            return True
        case cst.Call(func=cst.Name(value="NewType" | "TypeVar" | "cast")):
            return True
        case cst.Arg(keyword=cst.Name(value="strict")):
            return True
        case cst.Assign(targets=[cst.AssignTarget(target=cst.Name(value=name))]):
            bare = name.strip("_")  # CamelCase is a type alias
            return name == "__all__" or (bare[:1].isupper() and not bare.isupper())
    return False


def sample(root: Path, packages: list[str], count: int, seed: int) -> tuple[list[Mutant], int]:
    """(`count` mutants that compile, drawn from all; how many candidates there are)."""
    candidates = []
    for path in sorted(p for name in packages for p in (root / "agalign" / name).rglob("*.py")):
        wrapper, collector = MetadataWrapper(cst.parse_module(path.read_text(encoding="utf-8"))), _Collector()
        wrapper.visit(collector)
        candidates += [(path, wrapper.module, *found) for found in collector.found]
    random.Random(seed).shuffle(candidates)
    drawn: dict[str, Mutant] = {}
    for path, module, line, operator, old, new in candidates:
        if len(drawn) == count:
            break
        try:
            source = cst.ensure_type(module.deep_replace(old, new), cst.Module).code
            compile(source, path.name, "exec", dont_inherit=True)
        except (SyntaxError, cst.CSTValidationError, TypeError):
            continue  # for example a positional argument that now follows a keyword
        rows = difflib.unified_diff(module.code.splitlines(), source.splitlines(), n=0, lineterm="")
        changed = [row for row in rows if not row.startswith(("---", "+++", "@@"))]
        if changed:
            mutant = Mutant(path.relative_to(root).as_posix(), line, operator, "\n".join(changed), source)
            drawn[mutant.key] = mutant
    return list(drawn.values()), len(candidates)
