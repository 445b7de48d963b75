"""The list of commands that `agalign --help` prints, in plain text: typer's panels take as long to load as all else."""

from typing import Any

from typer.core import TyperGroup

_PANEL = "rich_help_panel"


class RootGroup(TyperGroup):
    """The commands by panel, without colours; the commands' own help has typer's look."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the usage, the options, a section of commands for each panel, and the examples."""
        self.format_usage(ctx, formatter)
        formatter.write_paragraph()
        formatter.write_text(self.help or "")
        options = [param.get_help_record(ctx) for param in self.get_params(ctx)]
        with formatter.section("Options"):
            formatter.write_dl([record for record in options if record is not None])
        for title, rows in self._commands(ctx).items():
            with formatter.section(title):
                formatter.write_dl(rows)
        formatter.write_paragraph()
        for line in (self.epilog or "").split("\n\n"):
            formatter.write(f"{line.replace('[bold]', '  ').replace('[/]', '')}\n")

    def _commands(self, ctx: Any) -> dict[str, list[tuple[str, str]]]:
        """(name, what it does) of the commands by panel, in the order of the first command of each."""
        panels: dict[str, list[tuple[str, str]]] = {}
        for name in self.list_commands(ctx):
            command = self.get_command(ctx, name)
            if command is not None and not command.hidden:
                panel = getattr(command, _PANEL, None)
                title = panel if isinstance(panel, str) else "Commands"
                panels.setdefault(title, []).append((name, command.get_short_help_str(limit=100)))
        return panels
