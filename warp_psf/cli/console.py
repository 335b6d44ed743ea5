"""What the commands say: errors and warnings in one line, tables, and bars of progress."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

import typer


@contextmanager
def one_sentence(stopped: str) -> Iterator[None]:
    """Ends the command with one line on stderr: status 2 after an expected error, 130 after Ctrl-C.

    Warnings become lines of the same kind.
    """
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: typer.echo(f"warp-psf: warning: {message}", err=True)
            yield
    except OSError as error:
        # What the system raises has its parts apart; what this library raises is a sentence already.
        fail(f"{error.filename}: {error.strerror}" if error.filename and error.strerror else str(error), 2)
    except ValueError as error:
        fail(str(error), 2)
    except KeyboardInterrupt:
        fail(stopped, 130)


def fail(sentence: str, status: int) -> NoReturn:
    # MuJoCo's messages span several lines.
    typer.echo(f"warp-psf: {' '.join(sentence.split())}", err=True)
    raise typer.Exit(status) from None


def print_table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Prints a table whose first column is a name and whose others are numbers."""
    from rich.console import Console
    from rich.table import Column, Table

    table = Table(titles[0], *(Column(title, justify="right", no_wrap=True) for title in titles[1:]))
    for row in rows:
        table.add_row(*row)
    Console(markup=False, highlight=False).print(table)


@contextmanager
def progress_bar() -> Iterator[Any]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = [TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn()]
    rate = TextColumn("{task.fields[rate]}")
    with Progress(*columns, rate, TimeRemainingColumn(), console=Console(stderr=True)) as bar:
        yield bar


def show_on(bar: Any) -> Callable[[str, float], None]:
    """`progress(label, share)` for whoever bakes or compiles: a line on the bar until its share reaches 1."""
    tasks: dict[str, Any] = {}

    def progress(label: str, share: float) -> None:
        if label not in tasks:
            tasks[label] = bar.add_task(label, total=100, rate="%")
        bar.update(tasks[label], completed=round(100 * share))
        if share >= 1.0:
            bar.remove_task(tasks.pop(label))

    return progress
