"""The site as MkDocs builds it: formulas, links of notebooks, search. Needs the extra `docs`; .ci/run has it.

`TORCHSPLINE_SITE` names a site that is built already; without it one is built here.
"""

import http.server
import json
import os
import re
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path

import pytest
from browser import Browser, needs_browser

sys.path.append(str(Path(__file__).resolve().parent.parent / "experiments"))

from pages import DOCS

pytest.importorskip("mkdocs", reason="no MkDocs: pip install -c constraints.txt -e '.[docs]'")
sections = pytest.importorskip(
    "pages.sections", reason="no Griffe: pip install -c constraints.txt -e '.[docs]'"
)
typeset = pytest.importorskip(
    "pages.typeset", reason="no latex2mathml: pip install -c constraints.txt -e '.[docs]'"
)

ROOT = Path(__file__).resolve().parent.parent


def text(markup: str) -> str:
    return re.sub(r"<[^>]*>", "", markup)


@pytest.mark.parametrize(
    ("latex", "shown"),
    [
        (r"\lambda'' w", "λ″w"),
        (r"\lambda_j'^2", "λj′2"),
        (r"X\,\mathrm{Exp}(v) \leftarrow -a", "XExp(v)←−a"),
        (r"a < b", "a&lt;b"),
        (r"\begin{align*} a &= b \\ c &= d \end{align*}", "a=bc=d"),
    ],
)
def test_formulas(latex, shown):
    found = typeset.mathml(latex, block=False)
    assert text(found) == shown
    assert found.startswith("<math")
    assert found.endswith("</math>")


def test_names_are_words_and_primes_no_superscripts():
    found = typeset.mathml(r"\mathrm{Exp}(\lambda') + \lambda_j'^2", block=True)
    assert "<mi>Exp</mi>" in found
    assert 'display="block"' in found
    assert found.count("<msup>") == 1
    assert re.search(r"<msup><mrow><msub>.*</msub><mo[^>]*>′</mo></mrow><mn>2</mn></msup>", found)


@pytest.mark.parametrize("latex", [r"\nosuchcommand x", "a & b"])
def test_what_cannot_be_translated_is_named(latex):
    with pytest.raises(ValueError, match=r"does not know (\\nosuchcommand|&) in the formula"):
        typeset.mathml(latex, block=False)


# ---------------------------------------------------------------------- docstrings


def test_docstrings_are_divided_into_parameters_and_errors():
    found = sections.divided(
        "Does it.\nArgs:\n    a, b: numbers,\n        m.\n    c: of it. d: of that, s.\n"
        "Raises:\n    TypeError, ValueError: a wrong\n    type. KeyError: none.\n"
    )
    assert found == (
        "Does it.\n\nArgs:\n    a: numbers,\n        m.\n    b: see `a`.\n    c: of it.\n    d: of that, s.\n"
        "\nRaises:\n    TypeError, ValueError: a wrong\n        type.\n    KeyError: none.\n"
    )


def test_fields_are_described_by_the_comments_above_them():
    lines = ["class X:", "    #: m,", "    #: in the world.", "    a: int", "    b: int", "", "    c: int"]
    found = sections.fields(lines, {"a": 4, "b": 5, "c": 7})
    assert found == {"a": "m,\n        in the world.", "b": "see `a`."}


def test_fields_of_results_are_in_the_reference(site):
    page = (site / "reference" / "fit" / "index.html").read_text(encoding="utf-8")
    assert "(3,) position of the IMU in the body, m." in page
    assert "that hardly turns; readings that have nothing in common with the trajectory." in page


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    if "TORCHSPLINE_SITE" in os.environ:
        return Path(os.environ["TORCHSPLINE_SITE"])
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-f", "configs/docs.yaml", "-d", str(folder)],
        cwd=ROOT, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder


def test_every_formula_of_the_derivations_is_typeset(site):
    source = re.sub(
        r"^```.*?^```$|`[^`\n]*`",
        "",
        (DOCS / "derivations.md").read_text(encoding="utf-8"),
        flags=re.S | re.M,
    )
    dollars = source.count("$") - source.count("$$")  # two for each formula
    page = (site / "derivations" / "index.html").read_text(encoding="utf-8")
    assert dollars > 300
    assert page.count("<math") == dollars // 2
    assert "arithmatex" not in page
    assert "$" not in re.sub(r"<(pre|code|script|style).*?</\1>", "", page, flags=re.S)


# ---------------------------------------------------------------------- in a browser


@pytest.fixture
def served(site):
    """The address of the site on this machine: browsers let pages of files start no search."""
    handler = partial(QuietHandler, directory=str(site))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()
        thread.join()


class QuietHandler(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


FOUND = "[...document.querySelectorAll('.md-search-result__item > a')].map(a => new URL(a.href).pathname.slice(1))"


@needs_browser
def test_search_finds_pages_and_asks_nobody_else(served):
    with Browser() as browser:
        browser.open(served)
        for words, wanted in (
            ("time offset", ["guides/fitting/", "stories/calibration/"]),
            ("read-out time", ["stories/exposure/"]),
            ("quaternion", ["conventions/"]),
        ):
            for typed in ("", words):
                browser.value(
                    f"""(() => {{
                      const field = document.querySelector('.md-search__input');
                      field.focus();
                      field.value = {json.dumps(typed)};
                      field.dispatchEvent(new Event('input', {{bubbles: true}}));
                      field.dispatchEvent(new KeyboardEvent('keyup', {{bubbles: true}}));
                    }})()"""
                )
                browser.wait(f"{FOUND}.length {'> 3' if typed else '== 0'}")
            first = list(dict.fromkeys(browser.value(FOUND)))[: len(wanted) + 1]
            assert set(wanted) <= set(first), f"{words}: {first}"
        hosts = set(
            browser.value(
                "performance.getEntriesByType('resource').map(x => new URL(x.name).host).filter(x => x)"
            )
        )
        assert hosts == {served.removeprefix("http://").rstrip("/")}


@needs_browser
def test_formulas_are_drawn_as_formulas(site):
    with Browser() as browser:
        browser.open((site / "derivations" / "index.html").as_uri())
        size = "(x => {const r = x.getBoundingClientRect(); return [r.width, r.height]})"
        fraction = browser.value(f"{size}(document.querySelector('math[display=block] mfrac'))")
        line = browser.value(f"{size}(document.querySelector('math:not([display=block]) mi'))")
        assert fraction[1] > 1.5 * line[1] > 0  # one above the other
        rows = browser.value(
            "[...document.querySelectorAll('mtable mtr')].map(x => x.lastElementChild.getBoundingClientRect().left)"
        )
        assert len(rows) == 3
        assert max(rows) - min(rows) < 1  # px: aligned at their signs
