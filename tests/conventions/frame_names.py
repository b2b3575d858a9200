"""Lint of frame names: follows `a_T_b` through the source and reports products, sums and assignments that do not meet.

It knows names, not values: what it cannot follow it leaves alone. Kinds of names, as in the conventions page:
`a_T_b`, `a_R_b`, `a_q_b` (transform, rotation, quaternion) and `a_p_x`, `a_v_x`, `a_n_x`, `a_t_b` (vectors in frame a).

Where two names are one frame, the line says so: `# frames: tool = arm`. Such a comment that nothing needs is reported.
"""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace

_NAME = re.compile(r"_*([a-z][a-z0-9]*(?:_[a-z0-9]+)*?)_([TRqpvnt])_([a-z][a-z0-9]*(?:_[a-z0-9]+)*)")
_ALIASES = re.compile(r"#\s*frames:\s*(.*)")
_SAME = {"clone", "contiguous", "cpu", "cuda", "detach", "double", "expand", "expand_as", "flatten", "float", "numpy"}
_SAME |= {"requires_grad_", "reshape", "squeeze", "to", "type_as", "unsqueeze", "astype", "copy", "matrix"}
_SAME_OF_FIRST = {
    "as_tensor",
    "asarray",
    "array",
    "from_numpy",
    "tensor",
    "broadcast_to",
    "normalize",
    "project_to_so3",
}
_INVERSE = {"inverse", "rigid_inverse", "inv", "pinv", "quat_conjugate"}
_APPLY = {"transform_points", "rotate_vectors"}
_METHOD_APPLY = {"apply", "rotate"}
_SAME_FRAME = {"cross", "dot", "vecdot", "cosine_similarity"}


@dataclass(frozen=True)
class Framed:
    """What a name or an expression says about frames; None is unknown."""

    kind: str
    """T, R, q, or v for any vector."""
    dst: str | None
    src: str | None = None
    is_result: bool = False
    """Whether it came out of a product or an inversion."""

    def __str__(self) -> str:
        middle = "..." if self.kind == "v" else self.src or "?"
        return f"{self.dst or '?'}_{self.kind}_{middle}"

    def inverse(self) -> "Framed":
        return replace(self, dst=self.src, src=self.dst, is_result=True)


@dataclass(frozen=True)
class Violation:
    line: int
    message: str


def parse_name(name: str) -> Framed | None:
    """Frames of a name; None where it is not a frame name."""
    match = _NAME.fullmatch(name)
    if match is None:
        return None
    dst, kind, src = match.groups()
    return Framed(kind, dst, src) if kind in "TRq" else Framed("v", dst)


def check_source(source: str) -> list[Violation]:
    """Violations in one file, in the order of its lines."""
    checker = _Checker(source)
    checker.visit(ast.parse(source))
    checker.report_unused_aliases()
    return sorted(checker.violations, key=lambda violation: violation.line)


class _Checker(ast.NodeVisitor):
    def __init__(self, source: str) -> None:
        self.violations: list[Violation] = []
        self._seen: set[tuple[int, int, str]] = set()
        self._functions: list[str] = []
        self._aliases: dict[tuple[int, frozenset[str]], bool] = {}
        """(line, the two names) -> whether something needed it."""
        for line, text in enumerate(source.splitlines(), start=1):
            if match := _ALIASES.search(text):
                for pair in match[1].split(","):
                    self._aliases[line, frozenset(name.strip() for name in pair.split("="))] = False

    def report_unused_aliases(self) -> None:
        for (line, names), used in self._aliases.items():
            if not used:
                self.violations.append(Violation(line, f"nothing needs `frames: {' = '.join(sorted(names))}`"))

    # --- statements ---

    def visit_Assign(self, node: ast.Assign) -> None:
        for target in node.targets:
            self._assign(target, node.value)
        self.generic_visit(node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self._assign(node.target, node.value)
        self.generic_visit(node)

    def visit_NamedExpr(self, node: ast.NamedExpr) -> None:
        self._assign(node.target, node.value)
        self.generic_visit(node)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        self._functions.append(node.name)
        self.generic_visit(node)
        self._functions.pop()

    def visit_Return(self, node: ast.Return) -> None:
        if node.value is not None and self._functions and parse_name(self._functions[-1]):
            self._bind(self._functions[-1], node.value)
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        for keyword in node.keywords:
            if keyword.arg is not None and parse_name(keyword.arg):
                self._bind(keyword.arg, keyword.value)
        self._frames(node)
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        self._frames(node)
        self.generic_visit(node)

    def _assign(self, target: ast.expr, value: ast.expr) -> None:
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple) and len(target.elts) == len(value.elts):
            for one_target, one_value in zip(target.elts, value.elts, strict=True):
                self._assign(one_target, one_value)
        elif isinstance(target, ast.Name):
            self._bind(target.id, value)
        elif isinstance(target, ast.Attribute):
            self._bind(target.attr, value)
        elif isinstance(target, ast.Subscript) and isinstance(target.slice, ast.Constant):
            self._bind(str(target.slice.value), value)

    def _bind(self, name: str, value: ast.expr) -> None:
        expected, found = parse_name(name), self._frames(value)
        if found is None or (expected is not None and self._agree(value, expected, found)):
            return
        if expected is not None:
            self._report(value, f"{name} is given {found}")
        elif found.is_result and found.kind == "T" and found.dst and found.src:
            self._report(value, f"{name} is given {found}: a transform is named by its frames")

    def _report(self, node: ast.expr, message: str) -> None:
        key = (node.lineno, node.col_offset, message)
        if key not in self._seen:  # an expression is followed once for itself and once for what it is part of
            self._seen.add(key)
            self.violations.append(Violation(node.lineno, message))

    # --- expressions ---

    def _frames(self, node: ast.expr) -> Framed | None:
        match node:
            case ast.Name():
                return parse_name(node.id)
            case ast.Attribute():
                return self._attribute(node)
            case ast.Subscript():
                return self._subscript(node)
            case ast.Call():
                return self._call(node)
            case ast.UnaryOp(op=ast.USub()):
                inner = self._frames(node.operand)
                return inner if inner is not None and inner.kind == "v" else None
            case ast.BinOp(op=ast.MatMult()):
                return self._product(node, self._frames(node.left), self._frames(node.right))
            case ast.BinOp(op=ast.Add() | ast.Sub() | ast.Mult() | ast.Div()):
                return self._elementwise(node)
            case ast.IfExp():
                both = (self._frames(node.body), self._frames(node.orelse))
                return both[0] if both[0] == both[1] else None
        return None

    def _attribute(self, node: ast.Attribute) -> Framed | None:
        inner = self._frames(node.value)
        if inner is None or inner.kind == "v":
            return parse_name(node.attr) or (inner if inner and node.attr in _SAME else None)
        if node.attr in ("R", "quat_wxyz"):
            return replace(inner, kind=node.attr[0])
        if node.attr == "t":
            return Framed("v", inner.dst)
        if node.attr in ("mT", "T"):
            return inner.inverse() if inner.kind == "R" else None
        return inner if node.attr in _SAME else parse_name(node.attr)

    def _subscript(self, node: ast.Subscript) -> Framed | None:
        if isinstance(node.slice, ast.Constant) and isinstance(node.slice.value, str):
            return parse_name(node.slice.value)
        inner = self._frames(node.value)
        if inner is None or inner.kind in "vq":
            return inner
        index = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        last = [ast.unparse(element) for element in index[-2:]]
        if last == [":3", ":3"]:
            return replace(inner, kind="R")
        if len(last) == 2 and last[0] in (":3", ":") and re.fullmatch(r"-?\d:?|\d:\d", last[1]):
            return Framed("v", inner.dst)  # a column: an axis or the origin of src, in dst
        keeps = all(text in (":", "...", "None") for text in last) or len(index) == 1
        return inner if keeps else None

    def _call(self, node: ast.Call) -> Framed | None:
        function, arguments = node.func, node.args
        name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
        owner = self._frames(function.value) if isinstance(function, ast.Attribute) else None
        first = self._frames(arguments[0]) if arguments else None
        second = self._frames(arguments[1]) if len(arguments) > 1 else None
        if name in _INVERSE:
            inner = owner or first
            return None if inner is None else inner.inverse()
        if owner is not None and name in _METHOD_APPLY:
            return self._apply(node, owner, first)
        if owner is not None and (name in _SAME or name in ("transpose", "swapaxes")):
            turned = name in ("transpose", "swapaxes")
            return owner.inverse() if turned and owner.kind == "R" else None if turned else owner
        if name in _APPLY and first is not None:
            return self._apply(node, first, second)
        if name in ("matmul", "bmm", "quat_multiply"):
            return self._product(node, first, second)
        if name == "einsum":
            return self._einsum(node)
        if name in _SAME_FRAME and first and second:
            return self._same_frame(node, first, second)
        if name == "rigid_from_rotation_translation" and first is not None:
            if second is not None and not self._meet(node, first.dst, second.dst):
                self._report(node, f"{first} is joined with a translation {second}")
            return replace(first, kind="T")
        if name in ("quat_to_matrix", "matrix_to_quat") and first is not None:
            return replace(first, kind="R" if name == "quat_to_matrix" else "q")
        if name == "RigidTransform":
            return self._rigid_transform(node)
        return first if name in _SAME_OF_FIRST else parse_name(name)

    def _rigid_transform(self, node: ast.Call) -> Framed | None:
        arguments = dict(zip(("dst", "src", "matrix"), node.args, strict=False))
        arguments |= {keyword.arg: keyword.value for keyword in node.keywords if keyword.arg}
        frames = [arguments.get(key) for key in ("dst", "src")]
        if not all(isinstance(frame, ast.Constant) for frame in frames):
            return None
        result = Framed("T", *(str(frame.value) for frame in frames if isinstance(frame, ast.Constant)))
        found = self._frames(arguments["matrix"]) if "matrix" in arguments else None
        if found is not None and not self._agree(node, result, found):
            self._report(node, f"RigidTransform {result} is given {found}")
        return result

    def _product(self, node: ast.expr, left: Framed | None, right: Framed | None) -> Framed | None:
        if left is None or left.kind == "v":
            return None
        if right is None:
            return None if left.dst is None else Framed(left.kind, left.dst, None, True)
        if not self._meet(node, left.src, right.dst):
            self._report(node, f"{left} @ {right}: {left.src} does not meet {right.dst}")
        if right.kind == "v":
            return Framed("v", left.dst)
        return Framed(right.kind, left.dst, right.src, True)

    def _apply(self, node: ast.expr, transform: Framed, vector: Framed | None) -> Framed | None:
        return self._product(node, transform, vector or Framed("v", None))

    def _einsum(self, node: ast.Call) -> Framed | None:
        if len(node.args) != 3 or not isinstance(node.args[0], ast.Constant):
            return None
        operands, result = str(node.args[0].value).replace("...", "").replace(" ", "").split("->")
        left_axes, right_axes = (axes[-2:] for axes in operands.split(","))
        left, right = self._frames(node.args[1]), self._frames(node.args[2])
        if left is None or left.kind == "v" or len(left_axes) != 2:
            return None
        if left_axes[1] == right_axes[0] and result.endswith((left_axes[0], left_axes[0] + right_axes[1:])):
            return self._product(node, left, right)
        if left_axes[0] == right_axes[0] and left.kind == "R" and result.endswith(left_axes[1] + right_axes[1:]):
            return self._product(node, left.inverse(), right)
        return None

    def _elementwise(self, node: ast.BinOp) -> Framed | None:
        left, right = self._frames(node.left), self._frames(node.right)
        if left is not None and right is not None and left.kind == right.kind == "v":
            return self._same_frame(node, left, right)
        known = left or right
        return known if known is not None and known.kind == "v" else None

    def _same_frame(self, node: ast.expr, left: Framed, right: Framed) -> Framed | None:
        if left.kind != "v" or right.kind != "v":
            return None
        if not self._meet(node, left.dst, right.dst):
            self._report(node, f"vectors of {left.dst} and of {right.dst} are combined")
        return left

    def _agree(self, node: ast.expr, expected: Framed, found: Framed) -> bool:
        if expected.kind != found.kind:
            return False
        return self._meet(node, expected.dst, found.dst) and self._meet(node, expected.src, found.src)

    def _meet(self, node: ast.expr, a: str | None, b: str | None) -> bool:
        if a is None or b is None or a == b:
            return True
        lines = range(node.lineno, (node.end_lineno or node.lineno) + 1)
        stated = [(line, frozenset((a, b))) for line in lines if (line, frozenset((a, b))) in self._aliases]
        self._aliases.update(dict.fromkeys(stated, True))
        return bool(stated)


def iterate_violations(sources: dict[str, str]) -> Iterator[str]:
    """`file:line: message` for every violation in files given as name -> text."""
    for name, source in sources.items():
        for violation in check_source(source):
            yield f"{name}:{violation.line}: {violation.message}"
