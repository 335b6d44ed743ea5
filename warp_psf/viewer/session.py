"""What is shown and how it answers: a simulation that plays, the people who look at it, and the pictures they get."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from warp_psf.viewer.develop import develop
from warp_psf.viewer.eye import Eye
from warp_psf.viewer.rendered import Look

# Pixels of drafts, each half as many again as the one before: 96 x 54 to 480 x 270.
DRAFTS = tuple(width * width * 9 // 16 for width in (96, 120, 144, 176, 216, 264, 320, 392, 480))
FIRST_DRAFT = DRAFTS.index(176 * 176 * 9 // 16)
# Seconds that a draft may take: beside it the browser shows it, which on two cores leaves 10 and more in a second.
DRAFT_SECONDS = 0.06
# A larger draft is tried when it should take this share of that at most, so that sizes do not swing to and fro.
ROOM = 0.75
# How many times as many pixels the next draft has, and a picture on the way from a draft to the large one.
NEXT_DRAFT, NEXT_PICTURE = 1.5, 4
# Seconds without a change after which a picture is drawn well.
STILL = 0.15
# A simulation that cannot be stepped and drawn in its own time plays slower than it: at most so many frames at once.
MOST_FRAMES = 4


class Scene(Protocol):
    """What can be shown: `RenderedScene`, or the light of a shadow slab."""

    layers: tuple[str, ...]

    def draft(self, data: Any, moment: int, eye: Eye, look: Look, pixels: int) -> dict[str, np.ndarray]: ...
    def picture(self, data: Any, moment: int, eye: Eye, look: Look, pixels: int) -> dict[str, np.ndarray]: ...
    def is_quick(self, moment: int, eye: Eye, look: Look, pixels: int) -> bool: ...
    def close(self) -> None: ...


@dataclass(frozen=True, eq=False)
class Shown:
    """A picture for a person: the frame's layers, the one that is shown as uint8 [height, width, 3], and whether it is
    a draft. time: of the simulation, seconds.
    """

    layers: dict[str, np.ndarray]
    image: np.ndarray
    is_draft: bool
    time: float


@dataclass(eq=False)
class _Person:
    """Someone who looks: from where, since when, and what they were shown last."""

    eye: Eye
    since: float
    show: Callable[[Shown], None]
    shown: tuple | None = None
    pixels: int = 0


@dataclass(eq=False)
class _Wishes:
    """What the simulation was asked to do since it was last looked after."""

    frames: int = 0
    reset: bool = False


@dataclass(eq=False)
class Session:
    """Shows a scene to people, each from their own eye; all see the same state and share what is chosen.

    scene: draws. states: gives the states of the simulation from its start, frame after frame. frames_per_second: of
    them. pixels: of a large picture. report: is told, in a sentence, what could not be done, and "" when something can.

    Methods may be called from any thread, but `work` and `run` from one alone: it steps the simulation and draws.
    """

    scene: Scene
    states: Callable[[], Iterator[Any]]
    frames_per_second: float = 30.0
    pixels: int = 640 * 360
    look: Look = field(default_factory=Look)
    report: Callable[[str], None] = lambda sentence: None
    draft: int = FIRST_DRAFT

    def __post_init__(self) -> None:
        self._changed = threading.Condition()
        self._people: dict[int, _Person] = {}
        self._wishes = _Wishes()
        self._playing_since: float | None = None
        self._played = 0
        self._look_since = float("-inf")
        self._stopped = False
        self._moment = 0
        self._stream = self.states()
        self.data = next(self._stream)

    @property
    def is_playing(self) -> bool:
        """Whether the simulation plays."""
        return self._playing_since is not None

    def watch(self, person: int, eye: Eye, show: Callable[[Shown], None], now: float | None = None) -> None:
        """Someone looks from an eye, perhaps another one than before. show: is called with each of their pictures."""
        with self._changed:
            known = self._people.get(person)
            if known is None:
                self._people[person] = _Person(eye, _clock(now), show)
            elif known.eye != eye:
                known.eye, known.since = eye, _clock(now)
            self._changed.notify()

    def leave(self, person: int) -> None:
        """Someone looks no more."""
        with self._changed:
            self._people.pop(person, None)

    def choose(self, *, now: float | None = None, **values: Any) -> None:
        """Changes fields of `Look`."""
        with self._changed:
            self.look = replace(self.look, **values)
            self._look_since = _clock(now)
            self._changed.notify()

    def touch(self) -> None:
        """What the scene itself shows has changed."""
        with self._changed:
            self._moment += 1
            self._changed.notify()

    def play(self, now: float | None = None) -> None:
        """Lets the simulation run in its own time, or slower where it cannot keep up."""
        with self._changed:
            if self._playing_since is None:
                self._playing_since, self._played = _clock(now), 0
            self._changed.notify()
        self.report("")

    def pause(self) -> None:
        """Halts the simulation."""
        with self._changed:
            self._playing_since = None
            self._changed.notify()

    def step(self) -> None:
        """Moves the simulation, which halts, on by a frame."""
        with self._changed:
            self._playing_since = None
            self._wishes.frames += 1
            self._changed.notify()

    def reset(self) -> None:
        """Takes the simulation back to its start, where it halts."""
        with self._changed:
            self._playing_since = None
            self._wishes = _Wishes(reset=True)
            self._changed.notify()
        self.report("")

    def stop(self) -> None:
        """Ends `run`."""
        with self._changed:
            self._stopped = True
            self._changed.notify()

    def warm(self, eye: Eye) -> None:
        """Draws what an eye sees once, and finds the size of drafts, so that the first person need not wait for it."""
        for _ in DRAFTS:
            before = self.draft
            for moment in (-1, -2):
                self._draw_draft(eye, self.look, moment)
            if self.draft == before:
                break
        self.scene.picture(self.data, self._moment, eye, self.look, self.pixels)

    def run(self) -> None:
        """Works until `stop`."""
        while not self._stopped:
            pause = self.work()
            with self._changed:
                if pause is None or pause > 0.0:
                    # What came between `work` and here has notified no one.
                    if not self._has_news():
                        self._changed.wait(pause)

    def work(self, now: float | None = None) -> float | None:
        """Steps the simulation where it is time, and draws at most one picture.

        Returns in how many seconds there is more to do, None where only a change makes more.
        """
        now = _clock(now)
        self._move(now)
        with self._changed:
            look, moment, playing = self.look, self._moment, self.is_playing
            people = list(self._people.values())
            wanted = [(moment, person.eye, look) for person in people]
            late = [index for index, person in enumerate(people) if person.shown != wanted[index]]
            soft = [index for index, person in enumerate(people) if person.pixels < self.pixels]
        # Who was shown something longest ago is served first.
        for index in late:
            self._show(people[index], wanted[index], self._first_pixels(wanted[index]))
            self._serve_last(people[index])
            return 0.0
        if playing:
            return max(0.0, self._next_frame() - now)
        waits = [max(people[index].since, self._look_since) + STILL - now for index in soft]
        for index, wait in zip(soft, waits, strict=True):
            if wait <= 0.0:
                self._show(people[index], wanted[index], self._next_pixels(people[index]))
                return 0.0
        return min(waits, default=None)

    def _has_news(self) -> bool:
        wishes = self._wishes.reset or self._wishes.frames > 0
        late = any(person.shown != (self._moment, person.eye, self.look) for person in self._people.values())
        return wishes or late or self._stopped

    def _serve_last(self, person: _Person) -> None:
        with self._changed:
            for key, known in list(self._people.items()):
                if known is person:
                    self._people[key] = self._people.pop(key)

    def _first_pixels(self, wanted: tuple[int, Eye, Look]) -> int:
        """How large something new is shown: as a draft, unless the large picture takes no time."""
        return self.pixels if self.scene.is_quick(*wanted, self.pixels) else min(DRAFTS[self.draft], self.pixels)

    def _next_pixels(self, person: _Person) -> int:
        """Larger than it was, and at once as large as it gets where that is not far."""
        following = person.pixels * NEXT_PICTURE
        return self.pixels if following * NEXT_PICTURE > 2 * self.pixels else following

    def _show(self, person: _Person, wanted: tuple[int, Eye, Look], pixels: int) -> None:
        moment, eye, look = wanted
        is_draft = pixels < self.pixels and person.shown != wanted
        if is_draft:
            layers = self._draw_draft(eye, look, moment)
        else:
            layers = self.scene.picture(self.data, moment, eye, look, pixels)
        image = develop(layers, look.layer, look.exposure)
        person.shown, person.pixels = wanted, pixels
        person.show(Shown(layers, image, is_draft, float(self.data.time)))

    def _draw_draft(self, eye: Eye, look: Look, moment: int) -> dict[str, np.ndarray]:
        start = time.perf_counter()
        layers = self.scene.draft(self.data, moment, eye, look, min(DRAFTS[self.draft], self.pixels))
        self._choose_draft(time.perf_counter() - start)
        return layers

    def _choose_draft(self, seconds: float) -> None:
        """The size of the next draft, by what this one took."""
        if seconds > DRAFT_SECONDS and self.draft > 0:
            self.draft -= 1
        elif seconds * NEXT_DRAFT < ROOM * DRAFT_SECONDS and self.draft < len(DRAFTS) - 1:
            self.draft += 1

    def _next_frame(self) -> float:
        """When the next frame of a simulation that plays is due."""
        since = self._playing_since
        return 0.0 if since is None else since + (self._played + 1) / self.frames_per_second

    def _move(self, now: float) -> None:
        """Does what was wished for, and steps what plays."""
        with self._changed:
            wishes, self._wishes = self._wishes, _Wishes()
            since = self._playing_since
            frames = wishes.frames
            if since is not None:
                due = int((now - since) * self.frames_per_second) - self._played
                frames += min(due, MOST_FRAMES)
                self._played += due
        if wishes.reset:
            self._stream = self.states()
            self.data = next(self._stream)
        for _ in range(frames):
            if not self._advance():
                break
        if wishes.reset or frames > 0:
            self.touch()

    def _advance(self) -> bool:
        try:
            self.data = next(self._stream)
        except StopIteration:
            self.pause()
            self.report("The simulation has ended; reset it to see it again.")
            return False
        except ValueError as error:
            self.pause()
            self.report(str(error))
            return False
        return True


def _clock(now: float | None) -> float:
    return time.monotonic() if now is None else now
