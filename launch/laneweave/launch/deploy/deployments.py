"""Reading the configuration of a deployment for a command that takes part in it."""

from __future__ import annotations

from pathlib import Path

from laneweave.protocol.config.loading import load_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.tables import Scenario


def load_deployment(config: Path | None, endpoint: str | None, **overrides: object) -> Scenario:
    """Return a deployment, which says where its router is.

    Args:
        config: a DEPLOYMENT.toml; None: the defaults.
        endpoint: of the router; goes before that of the file.
        **overrides: see `load_scenario`.

    Raises:
        BadInputError: the file is not valid, or there is no endpoint.
    """
    settings = load_scenario(config, network__endpoint=endpoint, **overrides)
    if not settings.network.endpoint:
        raise BadInputError(
            "network.endpoint", "", "an endpoint, in the configuration or with --endpoint"
        )
    return settings
