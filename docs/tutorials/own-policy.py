# %% [markdown]
# # 3. Your own policy
#
# A policy is one function. It sees the buffer and the newcomer, and says which slot to evict, or `REJECT`, or `ACCEPT`.
# Here is one that keeps the queue even: when the buffer is full, it drops every second message in turn.

# %%
from bufgym.policies import ACCEPT, REJECT, register


@register("every-second", memory={"slot": 0})
def every_second(buffer, arrival, memory):
    "A full queue evicts slots 1, 3, 5, ... in turn; after a pass it rejects one newcomer and begins again."
    if len(buffer.slots) < buffer.capacity:
        return ACCEPT
    slot = 1 + int(memory[0])
    if slot >= len(buffer.slots):
        memory[0] = 0
        return REJECT
    memory[0] += 1  # the slots behind move up by one, so the next odd one is one further
    return slot


# %% [markdown]
# `memory` is the policy's own state, fresh for each episode. [The guide](../guide/own-policy.md) has all that a policy
# may see, and its settings.
#
# ## Against the others

# %%
import bufgym

names = ["every-second", "min-motion-gap", "afr", "drop-oldest"]
compared = bufgym.compare(names, "lte", duration_s=20.0, seeds=2)
print(compared)

# %% [markdown]
# Put the function into a file, and every command takes it:
#
# ```
# bufgym bench --policy-file mine.py --policies every-second,afr,drop-oldest
# ```
#
# ## The picture

# %%
compared.plot().figure.savefig("own-policy.png")

# %% [markdown]
# The policy thins one interruption evenly, but not a slow link: while the link is slow,
# messages leave at the head, and its place in the queue no longer fits. AFR moves its place with every departure. Give
# `register` an `on_departure(buffer, memory)` that does the same, and try again.
#
# ![The regret of each policy](own-policy.png)
