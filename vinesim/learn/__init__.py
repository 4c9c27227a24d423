"""Learning tasks as Gymnasium vector environments, on batches of worlds (:mod:`vinesim.worlds`).

The import of this package registers them: ``import vinesim.learn``, then ``gymnasium.make_vec("vinesim/Reach-v0",
num_envs=8)``. The extra ``learn`` installs what this package needs.
"""

from vinesim.worlds.errors import MissingExtra

try:
    import gymnasium
except ImportError as error:
    raise MissingExtra(f"vinesim.learn needs gymnasium: pip install 'vinesim[learn]' ({error})") from error

for _task in ("Reach", "Expose"):
    gymnasium.register(
        f"vinesim/{_task}-v0",
        entry_point=f"vinesim.learn.one_world:{_task}One",
        vector_entry_point=f"vinesim.learn.{_task.lower()}:{_task}Env",
    )
