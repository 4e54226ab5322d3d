"""The life of a node: transitions that fail with one sentence and undo what they began."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from cello3d_ros.errors import Cello3dError

_SUCCESS, _FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class ManagedNode(LifecycleNode):
    """A lifecycle node of two stages: ``configure()`` prepares it, ``listen()`` connects it.

    What a stage makes it registers with ``configured`` or ``active``, which undo it in reverse
    order when the stage ends or fails.  ``is_configuring`` says that a signal may break off what
    happens.
    """

    def __init__(self, name: str) -> None:
        """Join the graph, unconfigured."""
        super().__init__(name)
        self.configured, self.active = ExitStack(), ExitStack()
        self.is_configuring = False
        self._is_starting = False
        self._failure: Exception | None = None
        change = self._service_change_state
        change.callback = self._refusing(change.callback)

    def configure(self) -> None:
        """Prepare everything that takes long or may fail.  Raises Cello3dError."""
        raise NotImplementedError

    def listen(self) -> None:
        """Start anew and subscribe."""
        raise NotImplementedError

    def start(self) -> None:
        """Configure and activate.  Raises what went wrong."""
        self._is_starting = self.is_configuring = True
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() != _SUCCESS:
                raise self._failure or RuntimeError("the node could not be started")
        self._is_starting = self.is_configuring = False

    def destroy_node(self) -> None:
        """Leave the graph at once: the state machine would keep the node in it."""
        self._state_machine.destroy_when_not_in_use()
        super().destroy_node()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Configure; a failure leaves the node unconfigured."""
        return self._attempt(self.configure, self.configured)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Listen; a failure leaves the node inactive."""
        return self._attempt(self.listen, self.active)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening; what is configured stays."""
        self.active.close()
        return _SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Go back to being unconfigured; parameters that were set stay set."""
        return self._put_away()

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Put everything away for good."""
        return self._put_away()

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Go back to being unconfigured."""
        return self._put_away()

    def _put_away(self) -> TransitionCallbackReturn:
        self.active.close()
        self.configured.close()
        return _SUCCESS

    def _attempt(self, stage: Callable[[], None], undo: ExitStack) -> TransitionCallbackReturn:
        self.is_configuring = True
        try:
            stage()
        except Exception as error:
            undo.close()
            self._failure = error
            if not self._is_starting:  # start() raises it
                known = isinstance(error, Cello3dError)
                self.get_logger().error(str(error) if known else traceback.format_exc())
            return _FAILURE
        finally:
            self.is_configuring = self._is_starting
        return _SUCCESS

    def _refusing(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Return the callback of ~/change_state that an impossible request does not kill."""

        def answer(request: Any, response: Any) -> Any:
            try:
                return callback(request, response)
            except RuntimeError as error:
                if not self.context.ok():
                    raise
                self.get_logger().warning(f"transition refused: {error}")
                response.success = False
                return response

        return answer
