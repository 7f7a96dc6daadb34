"""The base of every YAML section.

A section lives beside the code that it configures; ``config`` assembles the sections into the tree of a run.
The description of each field is the comment that ``pchem init`` writes.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, BaseModel, ConfigDict, model_validator
from pydantic_core import PydanticCustomError

#: kind of the complaint about a value that must not be repeated in a message
SECRET = "secret"

_SECRETS = re.compile(
    r"^[a-z][a-z0-9+.-]*:/+([^/@]*:[^/]*@|.*[?&](sig|signature|\w*token|x-amz-\w[\w-]*|awsaccesskeyid)=)",
    re.IGNORECASE | re.DOTALL,
)


class Section(BaseModel):
    """A frozen YAML section: unknown keys, NaN and infinities are refused."""

    removed: ClassVar[tuple[str, ...]] = ()  # keys of earlier versions, which are read and do nothing

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True)

    @model_validator(mode="before")
    @classmethod
    def _without_removed(cls, data: Any) -> Any:
        if not cls.removed or not isinstance(data, dict):
            return data
        return {key: value for key, value in data.items() if key not in cls.removed}


def holds_secret(place: str) -> bool:
    """Return whether a URL holds a password, a key or a signature: YAML, log and pages would show it."""
    return _SECRETS.match(place) is not None


#: What is said of such a URL, which is not repeated.
NO_SECRETS = (
    "a URL with a password, key or signature, which would be stored in the run's YAML; give keys as "
    "for AWS tools (AWS_ACCESS_KEY_ID, ~/.aws), or download the file first"
)


def _without_secrets(place: str) -> str:
    if holds_secret(place):
        raise PydanticCustomError(SECRET, NO_SECRETS)
    return place


#: A path, or a URL that holds no secret.
Place = Annotated[str, AfterValidator(_without_secrets)]
