"""The server's own watch over flow runs: no heartbeat for some time means `Crashed`.

What `flows.leases` does when somebody starts a run, a Prefect server does by itself with an automation. It
concerns the flows of this project alone, and only runs that have had a heartbeat.
"""

from __future__ import annotations

from datetime import timedelta
from typing import Literal

from prefect.client.orchestration import get_client
from prefect.client.schemas.objects import StateType
from prefect.events.actions import ChangeFlowRunState
from prefect.events.schemas.automations import AutomationCore, EventTrigger, Posture
from prefect.events.schemas.events import ResourceSpecification

from flows.leases import DEFAULT_HEARTBEAT_SECONDS, FLOWS, HEARTBEAT, MISSED_BEATS

__all__ = ["NAME", "dead_run_automation", "provide_automation"]

NAME = "extrags: runs without heartbeat are crashed"
ENDS = ("Completed", "Failed", "Cancelled", "Crashed")


def dead_run_automation(seconds: float = MISSED_BEATS * DEFAULT_HEARTBEAT_SECONDS) -> AutomationCore:
    """The automation.

    Args:
        seconds: a run that has been silent for so long is dead.
    """
    return AutomationCore(
        name=NAME,
        description="Flow runs of extrags whose heartbeat has stopped, after a power loss for instance.",
        trigger=EventTrigger(
            after={HEARTBEAT},
            expect={HEARTBEAT, *(f"prefect.flow-run.{end}" for end in ENDS)},
            match=ResourceSpecification({"prefect.resource.id": ["prefect.flow-run.*"]}),
            match_related=ResourceSpecification(
                {"prefect.resource.role": "flow", "prefect.resource.name": list(FLOWS)}
            ),
            for_each={"prefect.resource.id"},
            posture=Posture.Proactive,
            threshold=1,
            within=timedelta(seconds=seconds),
        ),
        actions=[
            ChangeFlowRunState(
                state=StateType.CRASHED,
                message="Ended unexpectedly: its heartbeat has stopped. What was finished is in the store; "
                "a new run resumes there.",
            )
        ],
    )


def provide_automation(
    automation: AutomationCore | None = None,
) -> Literal["created", "updated", "unchanged"]:
    """Create the automation on the server, or make the one of its name as it should be."""
    wanted = automation or dead_run_automation()
    with get_client(sync_client=True) as client:
        known = client.read_automations_by_name(wanted.name)
        if not known:
            client.create_automation(wanted)
            return "created"
        first, *more = known
        # The server's has an identifier beside what was asked for.
        changed = AutomationCore.model_validate(first.model_dump(exclude={"id"})) != wanted
        if changed:
            client.update_automation(first.id, wanted)
        for another in more:
            client.delete_automation(another.id)
        return "updated" if changed or more else "unchanged"
