"""``bufgym export``: agents as files of weights."""

from dataclasses import dataclass

from cyclopts import Group, Parameter

from bufgym.utils.errors import BufgymError


@Parameter(name="*", group=Group.create_ordered("Weights (.safetensors)"))
@dataclass(frozen=True)
class WeightOptions:
    name: str | None = None
    """The policy's name; must be given."""
    about: str | None = None
    """A sentence on the purpose of its training."""


def export(model: str, /, out: str, *, weights: WeightOptions = WeightOptions()) -> None:
    """Write a trained agent as a file of weights, read without torch.

    A model.zip holds pickles, so reading it can run any code: export models of your own alone.

    Args:
        model: The model.safetensors of a run, or the zip of your own PPO, A2C, DQN or MaskablePPO with MlpPolicy
            among candidates.
        out: File to write.
    """
    from bufgym.sb3 import export as networks

    if weights.name is None:
        raise BufgymError("--name must be given: the policy's name")
    print(f"wrote {networks.export(model, out, name=weights.name, about=weights.about or '')}")
