"""The description of the HTTP interface (OpenAPI), from which programs generate their clients.

FastAPI describes routes and models. Added here: who may ask, how each request can fail, the forms,
and an example of each answer.
"""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI
from pydantic import BaseModel, Field

JSON = "application/json"
OCTETS = "application/octet-stream"
BINARY_FILE = {"type": "string", "format": "binary"}
CALLBACK_FIELD = {
    "type": "string",
    "format": "uri",
    "description": "An address on a host that the server may call: the state is sent there at the "
    "end, signed with the token.",
}
SCHEMA_PLACE = "#/components/schemas/{model}"  # where a description refers to a model
# The kinds of files that clients get, by suffix; others are OCTETS. A fixed table, because the
# usual one depends on the operating system.
MEDIA_TYPES = {
    ".gif": "image/gif",
    ".glb": "model/gltf-binary",
    ".html": "text/html",
    ".jpg": "image/jpeg",
    ".json": JSON,
    ".mp4": "video/mp4",
}
SECURITY_SCHEME = {
    "type": "http",
    "scheme": "bearer",
    "description": "The server's token, which `spackle serve` prints or is given by `--token`.",
}

# When a request is refused with a status, and the reason as an example.
REASONS = {
    400: ("A file is empty, or the form is damaged.", "photo.jpg: the file is empty"),
    401: ("The token is missing or wrong.", "this needs the token that the server printed"),
    403: (
        "The name in the address is not the server's, or a page of another site asks.",
        "this server does not have that Host name",
    ),
    404: ("There is no such scene or file.", "there is no such scene"),
    408: ("The form arrived too slowly.", "the photo arrived too slowly"),
    409: (
        "The scene is not done, or failed; or a request with this Idempotency-Key still arrives.",
        "this scene is not done yet",
    ),
    413: ("The upload is too large.", "more than 200 MB: send a smaller photo"),
    415: ("A file is no picture of a known kind.", "notes.txt: not an image: give a photo"),
    422: (
        "An option or a part of the form is missing, unknown or has a bad value.",
        "options: disparity: input should be less than or equal to 2",
    ),
    429: (
        "Too many photos wait. The header Retry-After says after how many seconds to ask again.",
        "too many photos are waiting: try again in 10 seconds",
    ),
    503: ("The server cannot work now.", "the disk of the folder of scenes is full: 3 MB are left"),
    507: (
        "The disk of the server is full. Nothing is wrong with the request: send it again later.",
        "the server cannot store this now (No space left on device): try again later",
    ),
    500: ("The server has a fault.", "internal error: the reason is in the server's log"),
}
ANY_REQUEST = (403, 500)  # the statuses with which any request can be refused
ANY_FORM = (400, 408, 409, 413, 422, 429, 507)  # and those of any form that is sent

STATE_EXAMPLE: dict[str, Any] = {
    "id": "6f1c2a9b0d3e4f58",
    "name": "photo.jpg",
    "state": "running",
    "stage": "base",
    "share": 0.5,
    "line": "focal length 1234 px (from the photo)",
    "error": None,
    "files": ["photo.jpg"],
    "making": [],
    "place": None,
    "created": 1790000000.0,
    "ended": None,
    "parent": None,
    "edit": None,
}
QUEUED_EXAMPLE = {
    **STATE_EXAMPLE,
    "state": "queued",
    "place": 2,
    "stage": None,
    "share": None,
    "line": None,
}
# What an answer of 202 contains beside the state of the new scene.
ACCEPTED: dict[int | str, dict[str, Any]] = {
    202: {
        "description": "The photo or edit is queued.",
        "headers": {
            "Location": {
                "description": "Where the state of the new scene is.",
                "schema": {"type": "string"},
            }
        },
        "content": {JSON: {"example": QUEUED_EXAMPLE}},
    }
}
STATE: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The state.",
        "content": {JSON: {"example": STATE_EXAMPLE}},
    }
}
PAGE_OF_STATES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "A page of states.",
        "content": {JSON: {"example": {"scenes": [STATE_EXAMPLE], "next": None}}},
    }
}
HEALTH: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The server runs.",
        "content": {JSON: {"example": {"status": "ok", "version": "0.1.0", "base": "auto"}}},
    }
}
READY: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The server can complete photos.",
        "content": {JSON: {"example": {"status": "ready"}}},
    }
}
LINK: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The link.",
        "content": {
            JSON: {
                "example": {"path": "/shared/6f1c2a9b0d3e4f58/0f3a91c2b87d4e650f3a91c2b87d4e65/"}
            }
        },
    }
}
DELETED: dict[int | str, dict[str, Any]] = {204: {"description": "It is deleted."}}
FILE: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The file.",
        "content": {
            media_type: {"schema": BINARY_FILE} for media_type in (OCTETS, *MEDIA_TYPES.values())
        },
    }
}


class ErrorAnswer(BaseModel):
    """The answer to a refused request."""

    error: str = Field(description="The reason, in a line.")


def refusals(*statuses: int, needs_token: bool = True) -> dict[int | str, dict[str, Any]]:
    """The description of refusals, by status; those of any request are among them.

    `needs_token` says whether a request is also refused without the token.
    """
    answers: dict[int | str, dict[str, Any]] = {}
    token_statuses = [401] if needs_token else []
    for status in (*ANY_REQUEST, *token_statuses, *statuses):
        meaning, example = REASONS[status]
        answers[status] = {
            "model": ErrorAnswer,
            "description": meaning,
            "content": {JSON: {"example": {"error": example}}},
        }
    if 429 in answers:
        seconds = {"description": "Seconds.", "schema": {"type": "integer"}}
        answers[429]["headers"] = {"Retry-After": seconds}
    return answers


def describe_form(
    options: type[BaseModel], *required: str, **files: dict[str, str]
) -> dict[str, Any]:
    """The description of a form, as FastAPI's `openapi_extra`.

    Args:
        options: the model of its field `options`, which is JSON.
        *required: the names of the fields that must be there.
        **files: the descriptions of its files, by their names.
    """
    options_schema = {"$ref": SCHEMA_PLACE.format(model=options.__name__)}
    schema = {
        "type": "object",
        "required": list(required),
        "properties": {**files, "options": options_schema, "callback_url": CALLBACK_FIELD},
    }
    encoding = {"options": {"contentType": JSON}}
    content = {"multipart/form-data": {"schema": schema, "encoding": encoding}}
    return {"requestBody": {"required": True, "content": content}}


class DescribedApp(FastAPI):
    """A FastAPI app whose description is complete.

    `needs_token` says whether clients must send one, and `form_models` are the models of options
    in forms. Both are set before the description is first asked for.
    """

    needs_token: bool = False
    form_models: tuple[type[BaseModel], ...] = ()

    def openapi(self) -> dict[str, Any]:
        """The description as OpenAPI, made at the first call."""
        if self.openapi_schema is not None:
            return self.openapi_schema
        description = super().openapi()
        schemas = description["components"]["schemas"]

        # FastAPI announces an answer of its own, with 422, for every route that has a parameter;
        # `error_answer` replaces it.
        for operation in operations(description):
            automatic = operation["responses"].get("422", {}).get("description")
            if automatic == "Validation Error":
                del operation["responses"]["422"]
        for name in ("HTTPValidationError", "ValidationError"):
            schemas.pop(name, None)

        # Forms are no parameters of routes, so FastAPI does not know their models.
        for model in self.form_models:
            schema = model.model_json_schema(ref_template=SCHEMA_PLACE)
            schemas.update(schema.pop("$defs", {}))
            schemas[model.__name__] = schema

        if self.needs_token:
            description["components"]["securitySchemes"] = {"token": SECURITY_SCHEME}
            # At each operation, because some generators of clients read it only there.
            for operation in operations(description):
                operation.setdefault("security", [{"token": []}])
        return description


def operations(description: dict[str, Any]) -> list[dict[str, Any]]:
    """What a description says of each method of each path; these parts may be changed."""
    return [
        operation for methods in description["paths"].values() for operation in methods.values()
    ]


def resolve(description: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    """A schema, or the one that it refers to, with its own description where it has one."""
    if "$ref" not in schema:
        return schema
    name = schema["$ref"].rpartition("/")[2]
    schemas: dict[str, dict[str, Any]] = description["components"]["schemas"]
    return {**schemas[name], **schema}
