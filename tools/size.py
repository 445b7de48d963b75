"""Print the size of the code by folder: files, modules, code lines, module-level constants, lines kept from formatting.

    python tools/size.py [FOLDER ...]

Modules are the files but for `__init__.py`. Code lines are those with a token that is neither a comment nor part of a
docstring. Constants are UPPER_CASE names that a module assigns.
"""

import ast
import io
import sys
import tokenize
from pathlib import Path

FOLDERS = ("agalign", "tests", "benchmarks", "tools", "examples")
NO_CODE = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)


def code_lines(text: str, tree: ast.Module) -> int:
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    code = {n for t in tokens if t.type not in NO_CODE for n in range(t.start[0], t.end[0] + 1)}
    for node in ast.walk(tree):
        match node:
            case ast.Expr(value=ast.Constant(value=str())):
                code -= set(range(node.lineno, node.end_lineno + 1))
    return len(code)


def constants(tree: ast.Module) -> int:
    targets = [t for node in tree.body if isinstance(node, ast.Assign) for t in node.targets]
    targets += [node.target for node in tree.body if isinstance(node, ast.AnnAssign)]
    return sum(isinstance(n, ast.Name) and n.id.isupper() for target in targets for n in ast.walk(target))


def main() -> None:
    print("| folder | files | modules | code lines | constants | fmt: skip |\n|---|---|---|---|---|---|")
    for folder in sys.argv[1:] or FOLDERS:
        paths = sorted(Path(folder).rglob("*.py"))
        texts = [path.read_text(encoding="utf-8") for path in paths]
        trees = [ast.parse(text) for text in texts]
        modules = sum(path.name != "__init__.py" for path in paths)
        lines = sum(map(code_lines, texts, trees))
        skipped = sum(text.count("# fmt" + ": skip") for text in texts)
        print(f"| {folder} | {len(paths)} | {modules} | {lines} | {sum(map(constants, trees))} | {skipped} |")


if __name__ == "__main__":
    main()
