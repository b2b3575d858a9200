"""The JSON schema of result.json, made from the classes that read and write it.

python -m rmis_calib.results.schema > docs/result.schema.json
"""

import json
from typing import Any

from pydantic.json_schema import GenerateJsonSchema

from rmis_calib.io.outputs import RESULT_FORMAT
from rmis_calib.results.result import record_type


class _WithoutTitles(GenerateJsonSchema):
    """A title that repeats the key says nothing."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


def result_schema() -> dict[str, Any]:
    """JSON schema of result.json, with unit and frame of every key."""
    schema = record_type().json_schema(mode="serialization", schema_generator=_WithoutTitles)
    return {"$schema": GenerateJsonSchema.schema_dialect, **schema, "title": f"result.json, {RESULT_FORMAT}"}


if __name__ == "__main__":
    print(json.dumps(result_schema(), indent=2))
