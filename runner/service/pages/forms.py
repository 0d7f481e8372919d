"""Forms that a page sends."""

from __future__ import annotations

from typing import Annotated, Final
from urllib.parse import parse_qsl

from fastapi import Depends, Request

from runner.errors import RunnerError

MOST_FIELDS: Final = 100


async def form_of(request: Request) -> dict[str, str]:
    """Return the fields of a form as text; lines end as files have it.

    Raises:
        RunnerError: it is none.
    """
    body = await request.body()
    try:
        pairs = parse_qsl(
            body.decode("ascii"), keep_blank_values=True, max_num_fields=MOST_FIELDS, errors="strict"
        )
    except ValueError as error:
        raise RunnerError(f"form: found something that is none ({error}).") from error
    return {name: value.replace("\r\n", "\n") for name, value in pairs}


Form = Annotated[dict[str, str], Depends(form_of)]
