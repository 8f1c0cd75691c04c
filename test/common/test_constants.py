"""Each numeric constant has a text beside it, for its unit and where it comes from."""

import ast

from loopback import CHECKOUT

WRAPPED = {'array', 'float', 'range', 'round'}
"""Calls whose arguments are the constant."""


def is_numeric(value, none=()):
    """Whether an author chose a number of a value; 0 and 1 in vectors and tables are identities."""
    if isinstance(value, ast.Constant):
        return type(value.value) in {int, float} and value.value not in none
    if isinstance(value, ast.Dict):
        return any(is_numeric(item, (0, 1)) for item in value.values)
    if isinstance(value, ast.Tuple | ast.List | ast.Set):
        return any(is_numeric(item, (0, 1)) for item in value.elts)
    if isinstance(value, ast.Call):
        called = value.func.attr if isinstance(value.func, ast.Attribute) else value.func.id
        return called in WRAPPED and any(is_numeric(item) for item in value.args)
    if isinstance(value, ast.UnaryOp):
        return is_numeric(value.operand, none)
    return isinstance(value, ast.BinOp) and (is_numeric(value.left) or is_numeric(value.right))


def without_text(source):
    """Return the numeric constants of modules and classes that have no docstring or comment."""
    lines, missing = source.splitlines(), []
    bodies = [ast.parse(source).body]
    for body in bodies:
        for node, after in zip(body, [*body[1:], None], strict=True):
            if isinstance(node, ast.ClassDef) and 'Enum' not in str(
                [*map(ast.unparse, node.bases)]
            ):
                bodies.append(node.body)
            value = getattr(node, 'value', None)
            if not isinstance(node, ast.Assign | ast.AnnAssign) or not is_numeric(value):
                continue
            name = ast.unparse(node.targets[0] if isinstance(node, ast.Assign) else node.target)
            beside = (
                lines[node.lineno - 2].lstrip().startswith('#') or '#' in lines[node.lineno - 1]
            )
            below = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            if name.isupper() and not (beside or below):
                missing.append(name)
    return missing


def test_each_numeric_constant_has_a_text_beside_it():
    files = sorted((CHECKOUT / 'imu_calib').rglob('*.py'))
    found = {str(f.relative_to(CHECKOUT)): without_text(f.read_text()) for f in files}
    assert {name: missing for name, missing in found.items() if missing} == {}


def test_a_constant_without_one_is_found():
    told = '_LIMIT = -2 * 3.5\n"""s: why."""\nclass A:\n    # Why.\n    MOST = 1 << 4\n'
    assert without_text(told) == []
    assert without_text(told.replace('"""s: why."""\n', '').replace('# Why.', 'x = y')) == [
        '_LIMIT',
        'MOST',
    ]
    assert without_text('UP = (0.0, -1.0)\nUNITS = {"cm": 0.01}\nBITS = np.array([3])\n') == [
        'UNITS',
        'BITS',
    ]
