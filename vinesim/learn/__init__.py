"""Learning tasks as Gymnasium vector environments, on batches of worlds (:mod:`vinesim.worlds`).

The import of this package registers them: ``import vinesim.learn``, then ``gymnasium.make_vec("vinesim/Reach-v0",
num_envs=8)``. The extra ``learn`` installs what this package needs.
"""

from vinesim.worlds.errors import MissingExtra

try:
    import gymnasium
except ImportError as error:
    raise MissingExtra(f"vinesim.learn needs gymnasium: pip install 'vinesim[learn]' ({error})") from error

TASKS = {"reach": "reached", "expose": "exposed", "pick": "picked", "prune": "pruned"}
"""Tasks by name, each with the word for its success. Task ``reach`` is ``vinesim.learn.reach.ReachEnv``."""

for _task in TASKS:
    gymnasium.register(
        f"vinesim/{_task.capitalize()}-v0",
        entry_point=f"vinesim.learn.one_world:{_task.capitalize()}One",
        vector_entry_point=f"vinesim.learn.{_task}:{_task.capitalize()}Env",
    )
