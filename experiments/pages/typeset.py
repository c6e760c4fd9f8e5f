"""Formulas of the pages as MathML, which browsers draw without scripts: a hook of MkDocs, see configs/docs.yaml.

Pages write LaTeX between dollars, as GitHub reads it. `pymdownx.arithmatex` finds it, `latex2mathml` translates.
"""

import html
import logging
import re
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from latex2mathml.converter import convert_to_element

_log = logging.getLogger("mkdocs.hooks.typeset")

_INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.S)
_BLOCK = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.S)
_FUNCTIONS = ("sin", "cos", "cot", "exp", "ln")
_PRIMES = ("′", "″", "‴")


def mathml(latex: str, block: bool) -> str:
    """A formula as MathML.

    Raises:
        ValueError: a command that the translation does not know, which it would print as it stands.
    """
    tree = convert_to_element(latex, display="block" if block else "inline")
    for node in list(tree.iter()):
        node.text = html.unescape(node.text or "")
        if node.text.startswith("\\") or node.text == "&":
            raise ValueError(f"latex2mathml does not know {node.text} in the formula {latex!r}")
    for node in list(tree.iter()):
        _join_name(node)
        _lower_prime(node)
        _set_spaces(node)
    return ElementTree.tostring(tree, encoding="unicode")


def _join_name(node: Element) -> None:
    """A name such as Exp is one word; the translation writes it letter by letter."""
    if node.tag == "mrow" and len(node) > 1 and all(x.get("mathvariant") == "normal" for x in node):
        word = "".join(x.text or "" for x in node)
        node[:] = []
        node.append(Element("mi"))
        node[0].text = word


def _lower_prime(node: Element) -> None:
    """Primes stand behind their letter: as superscripts, in fonts whose primes are raised, they would be too small."""

    if node.tag not in ("msup", "msubsup"):
        return
    *base, above = node
    rest: list[Element] = []
    if above.tag == "mrow" and len(above) > 1 and above[0].text in _PRIMES:
        above, *rest = above
    if above.text not in _PRIMES:
        return
    if len(base) == 2:  # the index stays where it is
        index = Element("msub")
        index[:] = base
        base = [index]
    row = Element("mrow")
    mark = Element("mo", lspace="0", rspace="0")
    mark.text = above.text
    row[:] = [*base, mark]
    if rest:
        node.tag = "msup"
        power = Element("mrow")
        power[:] = rest
        node[:] = [row, power]
    else:
        node.tag = "mrow"
        node[:] = list(row)


def _set_spaces(row: Element) -> None:
    """Spaces as in TeX: signs close to what they belong to, none around a slash, one beside the name of a function."""
    last = None
    for i, node in reversed(list(enumerate(row))):
        before = row[i - 1] if i else None
        if node.tag == "mo" and node.text == "/":
            node.set("lspace", "0")
            node.set("rspace", "0")
        elif node.text == "−" and (
            before is None or (before.tag == "mo" and before.text not in (")", "]", "!"))
        ):
            node.set("form", "prefix")
            node.set("rspace", "0")
        elif node.tag == "mi" and node.text in _FUNCTIONS:
            if last is not None and last.tag != "mo":
                row.insert(i + 1, Element("mspace", width="0.167em"))
            if before is not None and before.tag in ("mi", "mn"):
                row.insert(i, Element("mspace", width="0.167em"))
        last = node


def typeset(content: str) -> str:
    """HTML with each formula that arithmatex marked replaced by MathML."""
    content = _BLOCK.sub(lambda m: mathml(html.unescape(m[1]).strip(), block=True), content)
    return _INLINE.sub(lambda m: mathml(html.unescape(m[1]), block=False), content)


def on_page_content(content: str, *, page: Any, **_: Any) -> str:
    """Called by MkDocs for the HTML of each page."""
    try:
        return typeset(content)
    except ValueError as error:
        _log.warning("%s: %s", page.file.src_path, error)  # with --strict, the end
        return content
