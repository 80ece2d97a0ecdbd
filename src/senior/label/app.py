"""The labelling page as a FastAPI application: routes and nothing else."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import FastAPI, HTTPException, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse, StreamingResponse
from jinja2 import Environment, FileSystemLoader
from pydantic import BaseModel, ConfigDict, Field, StringConstraints
from starlette.exceptions import HTTPException as StarletteHTTPException

from senior.label.desk import Given, Outcome, Side
from senior.label.drawing import Drawing
from senior.label.guard import Access, Guard
from senior.label.standing import Standing

PAGE = Path(__file__).parent / "page"
TYPES = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
LOOK_SECONDS = 0.5
"""How often a page is told that something changed."""

Name = Annotated[
    str, StringConstraints(strip_whitespace=True, min_length=1, max_length=60, pattern=r"^[^\x00-\x1f\x7f]+$")
]
Post = Annotated[str, StringConstraints(pattern=r"^[0-9A-Za-z-]{8,64}$")]


class _Sent(BaseModel):
    """``run``: identity of the run that is meant, as the state tells it; left out: the one that is served."""

    model_config = ConfigDict(extra="forbid")
    run: str | None = None


class NextPair(_Sent):
    """Who wants a pair."""

    annotator: Name


class Answered(_Sent):
    """An answer to a pair; ``post`` is made by the page, and sent again where nothing came back."""

    post: Post
    annotator: Name
    pair: int = Field(ge=1, le=2**53)
    answer: Side
    strength: Literal["slightly", "clearly"] | None = None
    seconds: float | None = Field(default=None, ge=0, le=1e7, allow_inf_nan=False)
    replays: int | None = Field(default=None, ge=0, le=10**9)


class Back(_Sent):
    """Undo or redo."""

    post: Post
    annotator: Name


class Goal(_Sent):
    """The sentence that says what the robot is to do."""

    goal: Annotated[str, StringConstraints(strip_whitespace=True, min_length=1, max_length=300)]


def application(run: Standing, access: Access, clips: bool = True, over: Callable[[], bool] = lambda: False) -> FastAPI:
    """The server of one run; ``clips``: have them drawn. ``over``: whether it is to end, which waits for nobody."""

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        drawing = Drawing(run.path) if clips else None
        try:
            yield
        finally:
            if drawing:
                await run_in_threadpool(drawing.close)
            run.desk.close()

    app = FastAPI(title="SENIOR labelling", version="1", lifespan=lifespan, docs_url=None, redoc_url=None)
    static_files = {file.name: file for file in PAGE.iterdir() if file.suffix in TYPES}
    templates = Environment(loader=FileSystemLoader(PAGE), autoescape=True)

    def rendered(name: str) -> HTMLResponse:
        response = HTMLResponse(
            templates.get_template(name).render(run=run.title, identity=run.desk.identity(), goal=run.goal)
        )
        if access.token:
            response.set_cookie(access.cookie, access.token, httponly=True, samesite="strict", max_age=30 * 24 * 3600)
        return response

    @app.exception_handler(RequestValidationError)
    async def _invalid(_: Request, error: RequestValidationError) -> Response:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"][1:])
        return JSONResponse({"detail": f"{where + ': ' if where else ''}{first['msg']}."}, 422)

    @app.exception_handler(StarletteHTTPException)
    async def _refused(_: Request, error: StarletteHTTPException) -> Response:
        return JSONResponse({"detail": error.detail}, error.status_code, error.headers)

    @app.get("/health")
    def health() -> dict[str, str]:
        """Whether the server is there. The only thing told without the token."""
        return {"status": "ok"}

    @app.get("/", response_class=HTMLResponse)
    def label_page() -> HTMLResponse:
        """The labelling page."""
        return rendered("label.html")

    @app.get("/overview", response_class=HTMLResponse)
    def overview_page() -> HTMLResponse:
        """Who answered, agreement, curves."""
        return rendered("overview.html")

    @app.get("/static/{name}", response_class=Response, responses=_told(404))
    def static(name: str) -> FileResponse:
        """The page's script, style and icon."""
        if name not in static_files:
            raise HTTPException(404, "There is no such file.")
        headers = {"cache-control": "no-cache"}
        return FileResponse(static_files[name], media_type=TYPES[static_files[name].suffix], headers=headers)

    @app.get("/clips/{name}.mp4", response_class=Response, responses=_told(404))
    def clip(name: str) -> FileResponse:
        """A clip; ``Range`` is honoured."""
        file = run.path / "label" / "clips" / f"{name}.mp4"
        if not (name.isalnum() and name.isascii() and run.desk.clip(name) and file.is_file()):
            raise HTTPException(404, "There is no such clip.")
        headers = {"cache-control": "private, max-age=31536000, immutable"}
        return FileResponse(file, media_type="video/mp4", headers=headers)

    def check_meant(sent: _Sent) -> None:
        """Another run may be served where a page's own was."""
        if sent.run not in (None, run.desk.identity()):
            raise HTTPException(410, "Another run is served here now.")

    @app.post("/api/next", responses=_told(410, 422))
    def next_pair(sent: NextPair) -> dict[str, Any]:
        """The pair to look at now, kept for two minutes, and the ones after it."""
        check_meant(sent)
        return run.turn(sent.annotator)

    def turned(annotator: str, outcome: Outcome) -> Any:
        turn = run.turn(annotator, outcome.said)
        return JSONResponse({"detail": outcome.refused, "turn": turn}, 409) if outcome.refused else turn

    @app.post("/api/answer", responses=_told(409, 410, 422))
    def answer(sent: Answered) -> Any:
        """Save an answer: it is on the disk when this is answered. Then the next pair."""
        check_meant(sent)
        given = Given(sent.pair, sent.answer, sent.strength, sent.seconds, sent.replays)
        return turned(sent.annotator, run.desk.answer(sent.post, sent.annotator, given))

    @app.post("/api/undo", responses=_told(409, 410, 422))
    def undo(sent: Back) -> Any:
        """Take back one's latest answer that is not trained on; its pair comes again."""
        check_meant(sent)
        return turned(sent.annotator, run.desk.undo(sent.post, sent.annotator))

    @app.post("/api/redo", responses=_told(409, 410, 422))
    def redo(sent: Back) -> Any:
        """Give again the answer that was taken back last."""
        check_meant(sent)
        return turned(sent.annotator, run.desk.redo(sent.post, sent.annotator))

    @app.post("/api/goal", responses=_told(410, 422))
    def goal(sent: Goal) -> dict[str, Any]:
        """Say anew what the robot is to do."""
        check_meant(sent)
        run.desk.write("goal", sent.goal)
        return run.state(None)

    @app.get("/api/state", responses=_told(422))
    def state(annotator: Annotated[Name | None, Query()] = None) -> dict[str, Any]:
        """How everything stands."""
        return run.state(annotator)

    @app.get("/api/events", response_class=StreamingResponse, responses=_told(422))
    async def events(annotator: Annotated[Name | None, Query()] = None) -> StreamingResponse:
        """The state whenever it changes, as server-sent events."""
        return StreamingResponse(_events(run, annotator, over), media_type="text/event-stream")

    @app.get("/api/overview")
    def overview() -> dict[str, Any]:
        """Numbers of the overview page."""
        return run.overview()

    app.add_middleware(Guard, access=access)
    return app


def _told(*codes: int) -> dict[int | str, dict[str, Any]]:
    """That these refusals come as a sentence."""
    return {code: {"description": "Refused, with the reason in a sentence."} for code in codes}


async def _events(run: Standing, annotator: str | None, over: Callable[[], bool]) -> AsyncIterator[str]:
    told, quiet = "", 0.0
    while not over():
        now = json.dumps(await run_in_threadpool(run.state, annotator))
        if now != told:
            told, quiet = now, 0.0
            yield f"event: state\ndata: {now}\n\n"
        elif quiet >= 15:
            quiet = 0.0
            yield ": still here\n\n"
        await asyncio.sleep(LOOK_SECONDS)
        quiet += LOOK_SECONDS
