"""From the words of a command line to the call of a function, by its signature and docstring."""

import inspect
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, get_args, get_origin, get_type_hints

_NONE = inspect.Parameter.empty
#: The same for all commands.
STATUS = "exit status: 0 all is well, 1 a check failed, 2 bad input or a file that cannot be written, 130 interrupted"


class Mistake(ValueError):
    """Words that do not fit the signature."""


def parse(
    program: str, function: Callable[..., Any], words: Sequence[str], examples: str = ""
) -> tuple[Callable[[], Any], bool]:
    """The call that `words` ask for, and whether they ask for JSON.

    Parameters without a default are positional, in order, unless some are keyword-only; all others are options, of
    which one that stands before keyword-only ones may be the first word, without its name. Lists take several words,
    truth values may stand alone, hyphens do for underscores. `--config FILE` reads options from YAML and `--json` asks
    for JSON, unless the function has a parameter of that name.

    Raises:
        Mistake: words that do not fit.
    """
    from argparse import RawDescriptionHelpFormatter

    from docstring_parser import parse as parse_docstring
    from jsonargparse import ActionConfigFile, ArgumentError, ArgumentParser, DefaultHelpFormatter

    class Formatter(RawDescriptionHelpFormatter, DefaultHelpFormatter):
        """Examples stay as they are written."""

    parameters, hints = inspect.signature(function).parameters, get_type_hints(function)
    docstring = parse_docstring(inspect.getdoc(function) or "")
    meanings = {x.arg_name: " ".join((x.description or "").split()) for x in docstring.params}
    parser = ArgumentParser(
        prog=program,
        description=docstring.short_description,
        epilog=f"examples:\n{_indented(examples)}\n\n{STATUS}" if examples else STATUS,
        formatter_class=Formatter,
        exit_on_error=False,
    )
    own_json = "json" in parameters
    if "config" not in parameters:
        parser.add_argument("--config", action=ActionConfigFile, help="YAML file of options")
    if not own_json:
        parser.add_argument(
            "--json", action="store_true", default=False, help="print one line of JSON instead of tables"
        )
    lists = {name: kind for name, hint in hints.items() if (kind := _of_list(hint)) is not None}
    for name, kind in lists.items():
        parser.add_argument(
            f"--{name}", type=kind, nargs="+", required=parameters[name].default is _NONE, metavar="WORD",
            help=meanings.get(name, ""),
        )  # fmt: skip
    named = any(x.kind is inspect.Parameter.KEYWORD_ONLY for x in parameters.values())
    parser.add_function_arguments(function, as_group=False, as_positional=not named, skip=set(lists))
    first = next((x.name for x in parameters.values() if x.kind is x.POSITIONAL_OR_KEYWORD), None)
    if named and first and words and not words[0].startswith("-"):
        words = [f"--{first}={words[0]}", *words[1:]]
    switches = {name for name in parameters if hints.get(name) is bool}
    try:
        chosen = parser.parse_args(_spelled_out(words, switches, {*parameters, "config"}))
    except ArgumentError as error:
        raise Mistake(" ".join(str(error).split())) from None
    # The second name is that of versions before 4.49.
    chosen = (parser.instantiate if hasattr(parser, "instantiate") else parser.instantiate_classes)(chosen)
    values = {name: chosen[name] for name in parameters}  # attributes such as items are taken
    return partial(function, **values), not own_json and chosen.json


def _of_list(hint: Any) -> Any:
    """Of what a `list[...]` or `list[...] | None` is a list; None of anything else."""
    kinds = [x for x in (hint, *get_args(hint)) if get_origin(x) is list]
    return get_args(kinds[0])[0] if kinds else None


def _spelled_out(words: Sequence[str], switches: set[str], options: set[str]) -> list[str]:
    """Underscores for hyphens in names of options, and `true` behind switches that stand alone."""
    result = []
    for i, word in enumerate(words):
        option, equals, value = word.removeprefix("--").partition("=")
        option = option.replace("-", "_")
        if not word.startswith("--") or option.split(".")[0] not in options:
            result.append(word)
            continue
        follows = i + 1 < len(words) and words[i + 1].lower() in ("true", "false")
        alone = option in switches and not equals and not follows
        result.append(f"--{option}=true" if alone else f"--{option}{equals}{value}")
    return result


def _indented(text: str) -> str:
    return "\n".join(f"  {line}" for line in inspect.cleandoc(text).splitlines())
