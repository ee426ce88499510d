"""Fields are documented as they are in the code: by the comment behind them."""

import ast
import re
from typing import Any

import griffe

COMMENT = re.compile(r"(?<!['\"])#\s*(?!type:|noqa)(.+)$")


class Fields(griffe.Extension):
    """Takes `focal_px: ...  # fx fy` for the docstring of `focal_px`."""

    def on_attribute_instance(self, *, node: Any, attr: griffe.Attribute, **_: Any) -> None:
        if attr.docstring or not isinstance(node, ast.AnnAssign) or not attr.parent.is_class:
            return
        line = attr.lines_collection[attr.filepath][(node.end_lineno or node.lineno) - 1]
        comment = COMMENT.search(line[node.end_col_offset :])
        if comment:
            attr.docstring = griffe.Docstring(comment[1], lineno=node.lineno, parent=attr)
