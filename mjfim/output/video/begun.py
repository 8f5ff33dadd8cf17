"""The video of a report, drawn while other files are written."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType

from mjfim.budget import StopToken
from mjfim.experiment.system import System
from mjfim.output.video.film import Film
from mjfim.output.video.record import Format, NoVideoError, Video, has_encoder
from mjfim.output.video.rendering import ADDED, render
from mjfim.output.video.results import Filmed, film_of

# The video or None, and the sentence that says why there is none.
Drawn = tuple[Video | None, str]


class VideoBegun:
    """A video that is drawn in the background; a context manager, at whose end the drawing ends.

    A fault in it is raised by `result`, so that the files that are written meanwhile are kept.

    Args:
        system: The experiment, resolved.
        result: What the video shows.
    """

    def __init__(self, system: System, result: Filmed) -> None:
        self._stop = StopToken()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="mjfim-video")
        self._drawn: Future[Drawn] = self._begun(system, result)

    def __enter__(self) -> VideoBegun:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """End the drawing if nobody has waited for it."""
        self._stop.request()
        self._thread.shutdown()

    def result(self) -> Drawn:
        """Wait for the video."""
        return self._drawn.result()

    def _begun(self, system: System, result: Filmed) -> Future[Drawn]:
        """Film the result in this thread, which may use the system, and draw in the other one."""
        ended: Future[Drawn] = Future()
        try:
            return self._thread.submit(_drawn, film_of(system, result), self._stop)
        except NoVideoError as reason:
            ended.set_result(_without(reason))
        except Exception as error:
            ended.set_exception(error)
        return ended


def _drawn(film: Film, stop: StopToken) -> Drawn:
    """Draw a film, if that takes little time."""
    # Every browser shows both; an mp4 is smaller.
    kind: Format = "mp4" if has_encoder("mp4") else "webp"
    try:
        video = render(film, kind, ADDED, stop)
        if len(video.data) > ADDED.max_bytes:
            raise NoVideoError("its file is larger than 2 MB")
    except NoVideoError as reason:
        return _without(reason)
    return video, ""


def _without(reason: NoVideoError) -> Drawn:
    """No video, and the sentence that says why."""
    return None, f"There is no video of the robot: {reason}."
