import pytest

from asia.agents.registry import AGENTS
from asia.testing import check_agent


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name != "random" else ())
        for name in sorted(AGENTS)
    ],
)
def test_agent_conforms(name: str) -> None:
    check_agent(AGENTS[name])


def test_the_suite_refuses_an_agent_that_repeats_itself() -> None:
    from asia.agents import AgentView, Proposal

    class Parrot:
        name = "parrot"

        def propose(self, view: AgentView) -> Proposal | None:
            return Proposal("def fit(t, c): ...", "none", "again", "none", "none")

    with pytest.raises(AssertionError, match="proposed before"):
        check_agent(Parrot)
