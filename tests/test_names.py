"""Frames cancel: `T_a_b @ T_b_c` may only be called `T_a_c`, and `T_a_b` maps points in b to a.

Every file of jaxnav/ is parsed. An expression's frames follow from the names in it; wherever it
gets a name (assignment, keyword, lambda parameter, loop variable, returning function) that name
must agree. What can't be inferred is not checked.
"""

import ast
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "jaxnav"
FRAME = "[a-z][a-z0-9]*"
TRANSFORM = re.compile(rf"^_*(?:T|Ts|R|Rs)_({FRAME})_({FRAME})(?:_|$)")
POINTS = re.compile(rf"^_*(?:p|ps|points?|corners?|centers?|positions?)_({FRAME})(?:_|$)")
# Calls that hand on the frames of one argument, with its place.
SAME_FRAMES = {"asarray": 0, "array": 0, "SE3": 0, "SO3": 0, "from_matrix": 0, "from_rotation": 0}
SAME_FRAMES |= {"from_rotation_and_translation": 0, "rotation_from_matrix": 0, "stop_gradient": 0}
SAME_FRAMES |= {"map": 1}  # jax.tree.map(function, tree)
SAME_FRAMES_METHODS = {"as_matrix", "rotation", "normalize", "reshape", "astype"}
SAME_FRAMES_ATTRIBUTES = {"wxyz_xyz", "wxyz"}


class Transform(NamedTuple):
    """Maps coordinates in `inner` to coordinates in `outer`."""

    outer: str
    inner: str

    def inverse(self) -> "Transform":
        return Transform(self.inner, self.outer)


class Points(NamedTuple):
    """Coordinates in one frame."""

    frame: str


Frames = Transform | Points | None


class FrameCheck:
    """Infers the frames of every expression of one file and collects what contradicts a name."""

    def __init__(self, tree: ast.Module, known_frames: set[str]):
        self.known_frames = known_frames
        self.errors: list[str] = []
        self._inferred: dict[int, Frames] = {}
        for node in ast.walk(tree):
            if isinstance(node, ast.expr):
                self.infer(node)
            for name, frames in self._bindings(node):
                self._hold_against(name, frames, node)

    def infer(self, node: ast.expr) -> Frames:
        if id(node) not in self._inferred:
            self._inferred[id(node)] = self._infer(node)
        return self._inferred[id(node)]

    def named(self, name: str) -> Frames:
        """What a name promises."""
        if (match := TRANSFORM.match(name)) and set(match.groups()) <= self.known_frames:
            return Transform(*match.groups())
        if (match := POINTS.match(name)) and match[1] in self.known_frames:
            return Points(match[1])
        return None

    def _infer(self, node: ast.expr) -> Frames:
        match node:
            case ast.Name(id=name):
                return self.named(name)
            case ast.Attribute(value=value, attr="T"):
                return _inverse(self.infer(value))
            case ast.Attribute(value=value, attr=name) if name in SAME_FRAMES_ATTRIBUTES:
                return self.infer(value)
            case ast.Attribute(attr=name):
                return self.named(name)
            case ast.Subscript(value=value, slice=index):
                return self._part(value, index)
            case ast.BinOp(left=left, op=ast.MatMult(), right=right):
                return self._product(self.infer(left), self.infer(right), node)
            case ast.BinOp(left=left, op=ast.Add() | ast.Sub(), right=right):
                return self._sum(self.infer(left), self.infer(right), node)
            case ast.Call():
                return self._call(node)
        return None

    def _call(self, node: ast.Call) -> Frames:
        name = _called(node)
        arguments = [self.infer(argument) for argument in node.args]
        if isinstance(node.func, ast.Attribute):
            of = self.infer(node.func.value)
            if name == "inverse":
                return _inverse(of)
            if name == "translation" and isinstance(of, Transform):
                return Points(of.outer)
            if name in ("apply", "multiply") and len(arguments) == 1:
                return self._product(of, arguments[0], node)
            if name in SAME_FRAMES_METHODS and of:
                return of
        if name == "transform_points" and len(arguments) == 2:
            return self._product(arguments[0], arguments[1], node)
        if name == "inv" and arguments:
            return _inverse(arguments[0])
        if name in SAME_FRAMES and len(arguments) > SAME_FRAMES[name]:
            return arguments[SAME_FRAMES[name]]
        if function := _lambda(node):
            return self.infer(function.body)
        return self.named(name)

    def _part(self, value: ast.expr, index: ast.expr) -> Frames:
        frames, text = self.infer(value), ast.unparse(index).replace(" ", "").strip("()")
        if isinstance(frames, Transform) and text.endswith(":3,3"):
            return Points(frames.outer)
        whole = not isinstance(index, ast.Slice | ast.Tuple)
        return frames if whole or text.endswith(":3,:3") else None

    def _product(self, left: Frames, right: Frames, node: ast.expr) -> Frames:
        match left, right:
            case Transform(outer, inner), Transform(next_outer, next_inner):
                self._require(inner == next_outer, node, f"{inner} meets {next_outer}")
                return Transform(outer, next_inner)
            case Transform(outer, inner), Points(frame):
                self._require(inner == frame, node, f"{inner} meets points in {frame}")
                return Points(outer)
            case Points(frame), Transform(outer, inner):  # rows of points, transposed rotation
                self._require(frame == outer, node, f"points in {frame} meet {outer}")
                return Points(inner)
        return None

    def _sum(self, left: Frames, right: Frames, node: ast.expr) -> Frames:
        if isinstance(left, Points) and isinstance(right, Points):
            self._require(left == right, node, f"adds {left.frame} and {right.frame}")
            return left
        return None

    def _bindings(self, node: ast.AST) -> Iterator[tuple[str, Frames]]:
        """(name, frames of what is bound to it) of one node."""
        match node:
            case ast.Assign(targets=targets, value=value):
                for target in targets:
                    yield from self._unpacked(target, value)
            case ast.AnnAssign(target=target, value=ast.expr() as value):
                yield from self._unpacked(target, value)
            case ast.NamedExpr(target=target, value=value):
                yield from self._unpacked(target, value)
            case ast.keyword(arg=str(name), value=value):
                yield name, self.infer(value)
            case (
                ast.For(target=target, iter=values) | ast.comprehension(target=target, iter=values)
            ):
                yield from self._looped(target, values)
            case ast.FunctionDef(name=name):
                for inner in ast.walk(node):
                    if isinstance(inner, ast.Return) and inner.value:
                        yield name, self.infer(inner.value)
            case ast.Call(args=arguments):
                if function := _lambda(node):
                    parameters = [parameter.arg for parameter in function.args.args]
                    yield from zip(parameters, map(self.infer, arguments), strict=False)
                elif source := re.search(r"_from_(Ts?_.*)", _called(node)):
                    yield source[1], self.infer(arguments[0]) if arguments else None

    def _unpacked(self, target: ast.expr, value: ast.expr) -> Iterator[tuple[str, Frames]]:
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            for one_target, one_value in zip(target.elts, value.elts, strict=False):
                yield from self._unpacked(one_target, one_value)
        elif isinstance(target, ast.Name):
            yield target.id, self.infer(value)
        elif isinstance(target, ast.Attribute):
            yield target.attr, self.infer(value)

    def _looped(self, target: ast.expr, values: ast.expr) -> Iterator[tuple[str, Frames]]:
        match target, values:
            case ast.Tuple(elts=targets), ast.Call(func=ast.Name(id="zip"), args=arguments):
                for one_target, one_values in zip(targets, arguments, strict=False):
                    yield from self._looped(one_target, one_values)
            case ast.Tuple(elts=[_, inner]), ast.Call(func=ast.Name(id="enumerate"), args=[of]):
                yield from self._looped(inner, of)
            case ast.Name(), _:
                yield from self._unpacked(target, values)

    def _hold_against(self, name: str, frames: Frames, node: ast.AST) -> None:
        promised = self.named(name)
        if promised and frames and isinstance(promised, type(frames)):
            self._require(promised == frames, node, f"{name} is given {'_'.join(frames)}")

    def _require(self, agrees: bool, node: ast.AST, problem: str) -> None:
        if not agrees:
            self.errors.append(f"line {getattr(node, 'lineno', '?')}: {problem}")


def _inverse(frames: Frames) -> Frames:
    return frames.inverse() if isinstance(frames, Transform) else None


def _called(node: ast.Call) -> str:
    match node.func:
        case ast.Name(id=name) | ast.Attribute(attr=name):
            return name
    return ""


def _lambda(node: ast.Call) -> ast.Lambda | None:
    """The function in `(lambda ...)(...)` and `vmap(lambda ...)(...)`."""
    match node.func:
        case ast.Lambda() as function:
            return function
        case ast.Call(args=[ast.Lambda() as function]):
            return function
    return None


def _frames_in(trees: Iterable[ast.Module]) -> set[str]:
    """Frames that occur in some transform's name. `R_...` may also be a filter's noise."""
    names = set()
    for tree in trees:
        for node in ast.walk(tree):
            match node:
                case ast.Name(id=name) | ast.Attribute(attr=name) | ast.arg(arg=name):
                    names.add(name)
    found = (TRANSFORM.match(name) for name in names if name.lstrip("_").startswith("T"))
    return {frame for match in found if match for frame in match.groups()}


def _errors(source: str) -> list[str]:
    tree = ast.parse(source)
    return FrameCheck(tree, _frames_in([tree])).errors


def test_composed_names_cancel() -> None:
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in PACKAGE.rglob("*.py")}
    frames = _frames_in(trees.values())
    assert {"world", "vehicle", "camera", "marker"} <= frames
    errors = {
        str(path.relative_to(PACKAGE)): found
        for path, tree in trees.items()
        if (found := FrameCheck(tree, frames).errors)
    }
    assert errors == {}


@pytest.mark.parametrize(
    "source",
    [
        "T_a_c = T_b_a @ T_b_c",
        "T_a_d = T_a_b @ T_b_c",
        "T_a_c = T_a_b @ T_b_c.inverse()",
        "self.T_a_c = self.rig.T_c_b @ T_b_a",
        "Ts_a_c: SE3 = rig.Ts_a_b[i] @ T_a_c",
        "T_a_d = T_a_b @ (T_b_c @ T_d_c)",
        "T_a_b = T_b_a",
        "T_a_b_prior, n = T_b_a_1, 2",
        "make(T_a_b=T_a_b.inverse())",
        "T_b_a = jaxlie.SE3(rig.Ts_a_b.wxyz_xyz[index])",
        "R_a_b = T_b_a.rotation().as_matrix()",
        "T_a_b = np.linalg.inv(np.asarray(rig.Ts_a_b.as_matrix(), float))",
        "jax.vmap(lambda T_a_b: T_a_b.log())(Ts_b_a)",
        "T_c_a = jax.vmap(lambda T_b_c: T_a_b @ T_b_c)(Ts_b_c)",
        "for T_a_b, n in zip(Ts_b_a, sizes): pass",
        "[T_a_b for T_a_b in Ts_b_a]",
        "def T_a_b(self):\n    return self.T_b_a",
        "pose = planar_from_T_a_b(T_b_a)",
        "p_a = T_a_b @ p_c; T_c_b",
        "p_b = transform_points(T_a_b, points_b)",
        "points_a_m = corners_b_m @ T_b_a.rotation().as_matrix().T",
        "points_a = T_a_b[:3, :3] @ points_b + T_b_a[:3, 3]",
        "x = transform_points(T_b_a.inverse(), corners_a_m)",
    ],
)
def test_a_contradiction_is_caught(source: str) -> None:
    assert len(_errors(source)) >= 1, source


@pytest.mark.parametrize(
    "source",
    [
        "T_a_c = T_a_b @ T_b_c",
        "self._Ts_a_d = self.T_a_b @ T_b_c_prior @ rig.Ts_d_c[i].inverse()",
        "T_a_b_est = T_a_b_1",
        "R_a_b = T_a_b.rotation().as_matrix(); R_b_a = R_a_b.T",
        "points_a = points_b @ T_a_b.rotation().as_matrix().T + T_a_b.translation()",
        "p_a = transform_points(T_a_b, T_b_c @ p_c)",
        "T_b_a = jax.tree.map(lambda leaf: leaf[0], bank.T_a_b).inverse()",
        "f(T_a_b=T_b_a.inverse(), Ts_c_a=jax.vmap(lambda T_b_a: T_c_b @ T_b_a)(Ts_b_a))",
        "R_speed_yaw = R_yaw_speed @ P; T_a_b",
        "def T_a_b_from_planar(pose):\n    return T_b_a.inverse()",
        "position_a = T_a_b[:3, 3]",
        "size = corners_px - center_px; T_a_b",
        "T_a_b = unknown(T_b_a)",
    ],
)
def test_what_cancels_passes(source: str) -> None:
    assert _errors(source) == []
