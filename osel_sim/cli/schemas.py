"""Write the JSON Schemas of all TOML files, for editors that complete and check: `make schemas`."""

from pathlib import Path
from typing import Any

from pydantic import TypeAdapter
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

from osel_sim.core import content
from osel_sim.core.docstrings import field_docstrings
from osel_sim.core.files import write_json
from osel_sim.formats.catalogue import CatalogueFile
from osel_sim.formats.dataset_mapping import DatasetMapping
from osel_sim.formats.policy_file import PolicyFile
from osel_sim.formats.task_schema import TaskFile
from osel_sim.ingestion.columns_schema import ColumnsFile
from osel_sim.training.recipe import RecipeFile

MODELS: dict[str, Any] = {
    "task": TaskFile,
    "policy": PolicyFile,
    "catalogue": CatalogueFile,
    "recipe": RecipeFile,
    "table-mapping": ColumnsFile,
    "dataset-mapping": DatasetMapping,
}


class _Schema(GenerateJsonSchema):
    """pydantic's JSON Schema as it fits TOML, which has no null, and without titles that only repeat a key."""

    def nullable_schema(self, schema: core_schema.NullableSchema) -> JsonSchemaValue:
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: core_schema.WithDefaultSchema) -> JsonSchemaValue:
        return self.generate_inner(schema["schema"]) if schema.get("default", ...) is None else super().default_schema(schema)

    def dataclass_schema(self, schema: core_schema.DataclassSchema) -> JsonSchemaValue:
        result = super().dataclass_schema(schema)
        for key, words in field_docstrings(schema["cls"]).items():
            if key in result["properties"]:
                result["properties"][key].setdefault("description", words)
        return result

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


def schemas() -> dict[str, dict[str, Any]]:
    """Name -> JSON Schema of each kind of file."""
    return {
        name: {"$schema": _Schema.schema_dialect, **TypeAdapter(model).json_schema(schema_generator=_Schema), "title": f"osel_sim: {name}"}
        for name, model in MODELS.items()
    }


def write_schemas(folder: Path) -> None:
    """Write `NAME.schema.json` of each kind of file."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, schema in schemas().items():
        write_json(folder / f"{name}.schema.json", schema)


if __name__ == "__main__":
    write_schemas(content.root() / "docs" / "schemas")
