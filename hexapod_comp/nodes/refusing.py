"""Answers instead of exceptions: what rclpy's own services raise must not end a running machine's node."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.service import Service


def unfailing(service: Service, warn: Callable[[str], object]) -> Callable[[Any, Any], Any]:
    """Return a service's callback that refuses a request where the one it has would raise.

    A transition that is not allowed in the present state, or a parameter of an unknown type, raises in rclpy's
    callback, and the executor lets it out: anybody could end the node with one request.

    Parameters
    ----------
    service : Service
        One of those that rclpy makes for every node.
    warn : callable
        Logs a warning.
    """
    callback = service.callback

    def answer(request: Any, response: Any) -> Any:
        try:
            return callback(request, response)
        except Exception as error:  # rclpy's own errors, Python's where it does not check: of many kinds
            warn(f"{service.srv_name} refused: {error}")
            return refusal(service.srv_type, request, str(error))

    return answer


def refusal(kind: Any, request: Any, reason: str) -> Any:
    """Return the response of a service type that says no: what is not filled in is false or empty."""
    response = kind.Response()
    if isinstance(response, SetParameters.Response):
        response.results = [SetParametersResult(reason=reason) for _ in request.parameters]
    return response
