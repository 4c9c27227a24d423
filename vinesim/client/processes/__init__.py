"""Processes that a client starts for a robot, so that neither the renderer nor ROS delays the client's loop.

Modules ``*_process`` run in the client. Modules ``*_worker`` run in a process, without the client and without MuJoCo.

* Start: ``RobotProcesses`` makes a ``SensorProcess`` and, with ROS 2, a ``RosProcess``. Each has a ``WorkerProcess``. A
  ``WorkerProcess`` starts a process (``SpawnedProcess``) that runs a ``SensorWorker`` or a ``RosWorker``: one ``Run``.
* Memory (``shared_memory``): the client writes snapshots of the world, of which only the newest counts, and a queue of
  step records, all of which count. The process writes its demands, as plain arrays.
* Pipe: pairs (kind, value). The process receives lists of bodies, sound and results of goals. The client receives
  "ready", counts, parameters and commands. Threads of the client send and receive, so the loop never waits for a pipe.
* A process that dies, or hangs (sends nothing for 15 s), is started again with new memory: at once, or after a pause of
  up to 60 s. A process that stands by may replace it. Only a failure of the first start ends the client.
* A slow process holds the loop (``held``) until the process has caught up, or has done nothing for 3 s although it had
  a CPU. Then the loop goes on, and messages that find no room are lost and counted. In lockstep the loop waits on.
"""
