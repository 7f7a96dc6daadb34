"""``--help`` in plain text, with commands and options below the headings of their ``rich_help_panel``."""

from __future__ import annotations

from typing import Any

from typer.core import TyperCommand, TyperGroup


def _write(formatter: Any, rows: list[tuple[str, tuple[str, str]]]) -> None:
    """Write rows (heading, record) below their headings, in the order in which these first appear."""
    for heading in dict.fromkeys(heading for heading, _ in rows):
        with formatter.section(heading):
            formatter.write_dl([record for each, record in rows if each == heading])


class PlainCommand(TyperCommand):
    """A command whose options are grouped."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments and options."""
        rows = []
        for each in self.get_params(ctx):
            usual = "Arguments" if each.param_type_name == "argument" else "Options"
            if record := each.get_help_record(ctx):
                rows.append((getattr(each, "rich_help_panel", None) or usual, record))
        _write(formatter, rows)


class PlainGroup(TyperGroup):
    """The program, whose commands are grouped."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write each command with its first line."""
        width = max(map(len, self.commands))
        rows = []
        for name, each in self.commands.items():
            summary = each.get_short_help_str(formatter.width - width - 4)
            rows.append((getattr(each, "rich_help_panel", ""), (f"{name:{width}}", summary)))
        _write(formatter, rows)
