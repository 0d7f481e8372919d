"""Branches of training: the steps at which a run was changed, with another action or other settings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import AfterValidator, Field, PlainSerializer, model_serializer

from runner.config.schedules import Probability, StepSize
from runner.config.sections import Exploration, Hysteretic, Quirks, WolfPhc
from runner.config.values import FrozenMapping, Optional, Section
from runner.util.values import Json


class Changes(Section):
    """The settings that can change while a run is trained; those that are left out stay as they are."""

    step_size: Optional[StepSize] = Field(default=None, description="As for the whole run.")
    discount: Optional[Probability] = Field(default=None, description="As for the whole run.")
    epsilon: Optional[Probability] = Field(default=None, description="As for the whole run.")
    exploration: Optional[Exploration] = Field(default=None, description="As for the whole run.")
    hysteretic: Optional[Hysteretic] = Field(default=None, description="The whole section.")
    wolf_phc: Optional[WolfPhc] = Field(default=None, description="The whole section.")
    quirks: Optional[Quirks] = Field(default=None, description="The whole section.")

    @property
    def given(self) -> Json:
        """The settings that change, by key."""
        return {key: value for key, value in self if value is not None}

    @model_serializer
    def _mapping(self) -> dict[str, object]:
        return {
            key: value.model_dump(mode="json") if isinstance(value, Section) else value
            for key, value in self.given.items()
        }


Text = Annotated[str, Field(min_length=1)]
Actions = Annotated[Mapping[Text, Text], AfterValidator(FrozenMapping), PlainSerializer(dict)]


class Branch(Section):
    """One step at which training was changed."""

    run: Text = Field(description="The id of the run that was branched.")
    step: Annotated[int, Field(ge=0, le=10**12)] = Field(
        description="The first training step that may differ, counted from 0."
    )
    actions: Actions = Field(
        default_factory=lambda: FrozenMapping({}),
        description="Agent to the name or number of the action it takes at this step; the others act as they "
        "would.",
    )
    settings: Changes = Field(default=Changes(), description="The settings that change from this step on.")
