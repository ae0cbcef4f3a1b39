"""What the documentation takes from the program itself when the site is built: commands, stages, the Python API.

mkdocs calls `on_page_markdown` for every page (`hooks` in mkdocs.yml). A line `<!-- commands -->`, `<!-- stages -->`,
`<!-- api -->`, `<!-- options -->`, `<!-- vocabulary -->` or `<!-- modules ROOM -->` of a page is replaced by what the
function of that name returns.
"""

from __future__ import annotations

import html
import inspect
import pkgutil
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import click

import wavebatch
from wavebatch.batch.options import describe_options
from wavebatch.cli import COMMANDS, main
from wavebatch.cli.command import group_options
from wavebatch.core.echoes import COLUMNS
from wavebatch.stages.chain import KINDS, STAGES, format_step


def on_page_markdown(markdown: str, **_: object) -> str:
    """The page with the generated parts in their places."""
    makers = {one.__name__: one for one in (commands, stages, api, options, vocabulary, modules)}
    markdown = _name_links(markdown)
    return re.sub(r"(?m)^<!-- (\w+)((?: \w+)*) -->$", lambda found: makers[found[1]](*found[2].split()), markdown)


def _name_links(markdown: str) -> str:
    """Links that have the name of a page's file get its title."""

    def name(found: re.Match) -> str:
        page = Path(__file__).with_name(found[1])
        title = page.read_text("utf-8").partition("\n")[0].removeprefix("# ") if page.exists() else found[1]
        return f"[{title}]({found[2]})"

    return re.sub(r"\[(?:docs/)?([\w-]+\.md)\]\(([^)]*)\)", name, markdown)


def commands() -> str:
    """Every command as click declares it: usage, text, arguments and options."""
    import_module("wavebatch.stages")
    context = click.Context(main, info_name="wavebatch")
    parts = []
    for name in COMMANDS:
        parts += _command(main.get_command(context, name), click.Context(main, info_name="wavebatch"), name)
    return "\n\n".join(parts)


def _command(command: click.Command, parent: click.Context, name: str, level: int = 2) -> Iterator[str]:
    context = click.Context(command, info_name=name, parent=parent)
    yield f"{'#' * level} {context.command_path}"
    usage = " ".join([context.command_path, *command.collect_usage_pieces(context)])
    yield f"```\n{usage}\n```"
    yield _paragraphs(inspect.cleandoc(command.help or ""))
    for heading, records in group_options(command, context):
        rows = [(names, text) for names, text in records if text and "--help" not in names]
        lines = [f"| {heading} | what it does |", "|---|---|"]
        lines += [f"| {_code(names)} | {_cell(_plain(text))} |" for names, text in rows]
        if rows:
            yield "\n".join(lines)
    examples = getattr(command, "examples", ())
    if examples:
        yield "```sh\n" + "\n".join(f"{line}  # {purpose}" for line, purpose in examples) + "\n```"
    if isinstance(command, click.Group):
        for inner in command.list_commands(context):
            yield from _command(command.get_command(context, inner), context, inner, level + 1)


def _cell(text: str) -> str:
    return re.sub(r"\s+", " ", text).replace("|", "&#124;")


def _code(text: str) -> str:
    """Text as code in a table: Markdown would end the cell at a bar, and show a backslash before it."""
    return f"<code>{_cell(html.escape(text, quote=False))}</code>"


def _paragraphs(text: str) -> str:
    """Help text as Markdown: paragraphs that click must not wrap (\\b) become preformatted text."""
    parts = []
    for part in re.split(r"\n\s*\n", text.replace("\f", "")):
        if part.startswith("\b"):
            parts.append("```\n" + part.lstrip("\b\n") + "\n```")
        else:
            parts.append(_plain(part))
    return "\n\n".join(parts)


def stages() -> str:
    """Every stage with its text, columns and parameters, as `wavebatch stages NAME` shows them."""
    import_module("wavebatch.stages")
    parts = []
    for kind in KINDS:
        parts.append(f"## {kind}")
        parts += [_stage(stage) for stage in sorted(STAGES.values(), key=lambda one: one.name) if stage.kind == kind]
    return "\n\n".join(parts)


def _stage(stage) -> str:
    lines = [f"### {stage.name}", "", *(_plain(part) + "\n" for part in _prose(stage))]
    lines += [
        f"- makes `{name}` [{COLUMNS[name].unit}]: {COLUMNS[name].meaning}" for name in stage.makes if name in COLUMNS
    ]
    if stage.makes:
        lines.append("")
    if stage.parameters:
        lines += ["| parameter | default | range | meaning |", "|---|---|---|---|"]
        for name, parameter in stage.parameters.items():
            low_high = f"{parameter.range[0]:g} to {parameter.range[1]:g}" if parameter.range else ""
            if parameter.choices:
                low_high = ", ".join(f"`{choice}`" for choice in parameter.choices)
            default = f'"{parameter.default}"' if isinstance(parameter.default, str) else str(parameter.default).lower()
            lines.append(f"| `{name}` | `{default}` | {_cell(low_high)} | {_cell(_plain(parameter.meaning))} |")
        lines.append("")
    defaults = {name: parameter.default for name, parameter in stage.parameters.items()}
    return "\n".join([*lines, "```toml", format_step(stage.name, defaults).rstrip(), "```"])


def _prose(stage) -> list[str]:
    """Paragraphs of a stage's docstring before its parameters, and its notes."""
    text = inspect.getdoc(stage.function) or ""
    sections = re.split(r"(?m)^(\w+)\n-+$", text)
    known = dict(zip(sections[1::2], sections[2::2], strict=True))
    names = "|".join(map(re.escape, stage.parameters)) or "(?!)"
    front = re.split(rf"(?m)^(?:{names}): ", sections[0])[0]
    sources = known.get("References", "").strip()
    parts = [front, known.get("Notes", ""), f"Source: {sources}" if sources else ""]
    return [part.strip() for text in parts for part in re.split(r"\n\s*\n", text) if part.strip()]


def _plain(text: str) -> str:
    """Text of a docstring as Markdown: characters that would be markup are kept as they are."""
    pieces = re.split(r"(`[^`]*`)", re.sub(r"\s+", " ", text.replace("``", "`")).strip())
    plain = "".join(
        piece if piece.startswith("`") else re.sub(r"([*_\[\]#])", r"\\\1", html.escape(piece, quote=False))
        for piece in pieces
    )
    return _name_links(re.sub(r"docs/((?:algorithms|las-waveforms)\.md)", r"[\1](\1)", plain))


def vocabulary() -> str:
    """Which command has which of the options that several of them have."""
    have: dict[str, list[str]] = {}
    for name in COMMANDS:
        command = main.get_command(click.Context(main), name)
        parts = getattr(command, "commands", {}) or {"": command}
        for inner, one in parts.items():
            for option in one.params:
                if isinstance(option, click.Option):
                    have.setdefault(max(option.opts, key=len), []).append(f"{name} {inner}".strip())
    shared = {name: found for name, found in have.items() if len(found) > 1}
    lines = ["| option | commands |", "|---|---|"]
    return "\n".join(lines + [f"| `{name}` | {', '.join(found)} |" for name, found in sorted(shared.items())])


def options() -> str:
    """The keywords of `wavebatch.run`: the fields of RunOptions."""
    lines = ["| keyword | type | meaning |", "|---|---|---|"]
    for entry in describe_options().replace("\n    ", "\t").splitlines():
        head, text = entry.split("\t")
        name, kind = head.split(" : ", 1)
        lines.append(f"| `{name}` | `{_cell(kind)}` | {_cell(_plain(text))} |")
    return "\n".join(lines)


def api() -> str:
    """The names that `import wavebatch` gives, each with its docstring."""
    names = [name for name in getattr(wavebatch, "__all__", ()) if not name.startswith("__")]
    parts = []
    for name in names:
        found = getattr(wavebatch, name)
        if getattr(found, "__module__", None) and getattr(found, "__qualname__", None):
            parts.append(f"::: {found.__module__}.{found.__qualname__}")
    return "\n\n".join(parts)


def modules(room: str) -> str:
    """Public functions and classes of a room, module by module."""
    # Links to public names lead to the page of the API: names that have two places would be a warning.
    options = "    options: {show_root_full_path: true, heading_level: 2, skip_local_inventory: true}"
    found = sorted(_modules(import_module(f"wavebatch.{room}")))
    return "\n\n".join(f"::: {module}\n{options}" for module in found)


def _modules(package) -> Iterator[str]:
    for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        source = Path(found.module_finder.path) / f"{found.name.rpartition('.')[2]}.py"
        if not found.ispkg and source.exists():
            yield found.name
