"""What every configuration class shares."""

from pydantic import BaseModel, ConfigDict


class Config(BaseModel):
    """A frozen set of knobs that refuses names it does not know."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, ser_json_inf_nan="constants")
