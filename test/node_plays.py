"""Recordings played through a node of its own process, over DDS."""

from cello3d_ros.ros import replay
from cello3d_ros.ros.process import NodeProcess


def played(tmp_path, domain_id, recording, **settings):
    """Play through a node of the shipped model; settings of the section node."""
    parameters = {f"node.{name}": value for name, value in settings.items()}
    with NodeProcess(tmp_path / "log", domain_id, parameters) as process:
        player = replay.Player(domain_id, check=process.check)
        try:
            found = replay.play(player, recording)
        finally:
            player.close()
        assert process.stop() == 0
        assert "Traceback" not in process.output()
    return found
