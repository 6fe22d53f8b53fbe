"""The verb ``watch``: subscribes to a machine's topics and shows its state on a page served by viser."""

from __future__ import annotations

import contextlib
import io
import logging
import socket
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from http import HTTPStatus
from ipaddress import ip_address
from typing import Any, TypeVar
from urllib.parse import urlsplit

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState

from ..errors import HexapodError
from ..formats.pages import render
from ..machine.geometry import HexapodGeometry
from ..machine.kinematics import solve_pose
from ..pose import Pose, rotation_angle
from ..ros.base import ERROR, EVENT_QOS, NEWEST_QOS, OK, WARN, profile, status_prefix
from ..ros.messages import StrutReader, message_pose, nanoseconds_of, read_message
from ..ros.outputs import correction_colour
from ..ros.process import QUIET, SPIN_PERIOD, RosSession

# Best effort, so that no publisher waits for this page; a queue for all commands between two calls of spin_once
STREAM_QOS = profile(100, reliable=False)

SILENT_AFTER = 2.0  # Time without a message after which a value is shown as not known, s
WINDOW = 5.0  # Time over which latencies are shown, s
MOST_DELAYS = 10_000  # Number of commands in WINDOW at 2 kHz
UPDATE_PERIOD = 0.1  # Period of the page's updates, s

NODES = ("compensator", "strut_drive")


@dataclass(frozen=True)
class WatchedError:
    """A tool error, actual − commanded, along the axes of ``work``."""

    displacement: np.ndarray  # shape (3,), m
    turn: float  # angle of the rotation error, rad
    deviation: float = float("nan")  # standard deviation of the displacement vector, m; NaN: not known


@dataclass(frozen=True)
class View:
    """The state of a machine as the page shows it; None: not known."""

    platform: Pose | None = None  # ``pose_platform_in_base`` from ``tool_pose_estimate``
    commanded: Pose | None = None  # ``pose_platform_in_base`` from the commanded struts without corrections
    corrections: np.ndarray | None = None  # strut corrections, shape (6,), m
    measured: np.ndarray | None = None  # measured struts, shape (6,), m
    predicted: WatchedError | None = None  # error without compensation, from ``~/predicted_error``
    left: WatchedError | None = None  # residual error, by ``tool_pose_estimate``
    seen: WatchedError | None = None  # residual error, by ``tool_pose_true``
    delays: Sequence[float] = ()  # from a command's stamp to the receipt of its strut command by this page, s
    states: dict[str, DiagnosticStatus] = field(default_factory=dict)  # newest status of each node


T = TypeVar("T")


class Watcher:
    """Subscriptions to a machine's topics; `view` evaluates the newest message of each."""

    def __init__(self, geometry: HexapodGeometry, node: Node) -> None:
        self._geometry, self._reader = geometry, StrutReader()
        self._guess = geometry.home
        self._newest: dict[str, tuple[bytes, float]] = {}
        self._states: dict[str, tuple[DiagnosticStatus, float]] = {}
        self._delays: deque[tuple[float, float]] = deque(maxlen=MOST_DELAYS)
        self.node = node
        self._prefixes = {name: status_prefix(node.get_namespace(), name) for name in NODES}
        node.create_subscription(JointState, "strut_commands", self._on_command, STREAM_QOS, raw=True)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, EVENT_QOS)
        for topic, kind in (
            ("strut_corrections", JointState),
            ("strut_states", JointState),
            ("tool_pose_estimate", PoseStamped),
            ("tool_pose_true", PoseStamped),
            ("compensator/predicted_error", PoseWithCovarianceStamped),
        ):
            node.create_subscription(kind, topic, partial(self._keep, topic), NEWEST_QOS, raw=True)

    def view(self) -> View:
        now = time.monotonic()
        corrections = self._read("strut_corrections", self._lengths, now)
        commands = self._read("strut_commands", self._lengths, now)
        commanded = None if commands is None or corrections is None else self._pose_of(commands - corrections)
        tool, true = (self._read(topic, _tool, now) for topic in ("tool_pose_estimate", "tool_pose_true"))
        # the tool in the compensator's newest status, or the geometry's default tool
        status, _ = self._states.get("compensator", (DiagnosticStatus(), 0.0))
        named = next((entry.value for entry in status.values if entry.key == "tool"), "")
        in_use = self._geometry.tools.get(named, self._geometry.tool)
        return View(
            platform=None if tool is None else tool @ in_use.inverse(),
            commanded=commanded,
            corrections=corrections,
            measured=self._read("strut_states", self._lengths, now),
            predicted=self._read("compensator/predicted_error", _predicted, now),
            left=self._error(tool, commanded, in_use),
            seen=self._error(true, commanded, self._geometry.tool),
            delays=tuple(delay for at, delay in self._delays if now - at <= WINDOW),
            states={name: status for name, (status, at) in self._states.items() if now - at < SILENT_AFTER},
        )

    def _keep(self, topic: str, data: bytes) -> None:
        """Keep a topic's newest message, which `view` parses."""
        self._newest[topic] = (data, time.monotonic())

    def _on_command(self, data: bytes) -> None:
        self._keep("strut_commands", data)
        try:
            stamp = nanoseconds_of(read_message(data, JointState).header.stamp)
        except HexapodError:
            return
        self._delays.append((time.monotonic(), (self.node.get_clock().now().nanoseconds - stamp) * 1e-9))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            for name, prefix in self._prefixes.items():
                if status.name.startswith(prefix):
                    self._states[name] = (status, time.monotonic())

    def _read(self, topic: str, read: Callable[[bytes], T], now: float) -> T | None:
        """Return `read(data)` of a topic's newest message; None if this message is invalid or over SILENT_AFTER old."""
        data, at = self._newest.get(topic, (b"", -np.inf))
        if now - at > SILENT_AFTER:
            return None
        try:
            return read(data)
        except HexapodError:
            return None

    def _lengths(self, data: bytes) -> np.ndarray:
        return self._reader.read(read_message(data, JointState))

    def _pose_of(self, lengths: np.ndarray) -> Pose | None:
        """Return the platform's pose in ``base`` for nominal strut lengths, m; None if no pose has these lengths."""
        try:
            self._guess = solve_pose(self._geometry, lengths, self._guess)
        except HexapodError:
            self._guess = self._geometry.home
            return None
        return self._guess

    def _error(self, tool: Pose | None, commanded: Pose | None, in_platform: Pose) -> WatchedError | None:
        """Return the error of the tool pose `tool`, given the commanded platform pose; both poses are in ``base``."""
        if tool is None or commanded is None:
            return None
        target = commanded @ in_platform
        displacement = self._geometry.work.rotation.T @ (tool.position - target.position)
        return WatchedError(displacement, rotation_angle(tool.rotation @ target.rotation.T))


def watch(
    geometry: HexapodGeometry, show: Callable[[View], object], going_on: Callable[[], bool], namespace: str = ""
) -> None:
    """Show a machine's present state every UPDATE_PERIOD while `going_on()` is true."""
    with RosSession("hexapod_comp_watch", namespace, **QUIET) as session:
        watcher, due = Watcher(geometry, session.node), time.monotonic()
        while going_on():
            session.spin_once(min(SPIN_PERIOD, max(0.0, due - time.monotonic())))
            if time.monotonic() >= due:
                show(watcher.view())
                due = time.monotonic() + UPDATE_PERIOD


def _tool(data: bytes) -> Pose:
    return message_pose(read_message(data, PoseStamped))


def _predicted(data: bytes) -> WatchedError:
    message: Any = read_message(data, PoseWithCovarianceStamped)
    error = message_pose(message.pose)
    variance = sum(message.pose.covariance[index] for index in (0, 7, 14))
    deviation = float(np.sqrt(variance)) if variance >= 0.0 else float("nan")
    return WatchedError(error.position, rotation_angle(error.rotation), deviation)


# ---- the page ----

GREY = (128, 128, 140)
UNKNOWN = (50, 50, 55)  # of struts without corrections, darker than GREY, since viser shows these colours lighter

STEEL = (110, 150, 210)
GOLD = (240, 190, 60)
COLOURS = {OK: "#3fb950", WARN: "#d9a520", ERROR: "#f85149"}
SILENT = "#8b949e"

# Keys of the diagnostics that the page shows, with their labels
KEYS = {
    "commanded_by": "commanded by",
    "command_rate_hz": "commands per second",
    "refused": "refused",
    "last_refusal": "last refusal",
    "model": "model",
    "compensation": "compensation",
}


class WatchPage:
    """A web page that shows views of a machine in 3-D and as text; it cannot change the machine."""

    def __init__(self, geometry: HexapodGeometry, host: str = "127.0.0.1", port: int = 8080) -> None:
        self._geometry = geometry
        self._server = _serve(host, port)
        shown = f"[{host}]" if ":" in host else host
        self.address = f"http://{shown}:{self._server.get_port()}"
        self._size = geometry.characteristic_length
        self._camera()
        scene, home = self._server.scene, geometry.home
        thick = 0.06 * self._size
        base = _outline(geometry.base_joints)
        scene.add_line_segments("/base", base, GREY, thickness=0.5 * thick)
        platform = _outline(geometry.platform_joints)
        self._platform = scene.add_line_segments("/platform", platform, STEEL, thickness=thick)
        tool = np.array([[np.zeros(3), geometry.tool.position]])
        scene.add_line_segments("/platform/spindle", tool, GOLD, thickness=thick)
        for name, pose in (("/platform/tool", geometry.tool), ("/work", geometry.work)):
            frame = scene.add_frame(name, axes_length=0.4 * self._size, axes_radius=0.2 * thick)
            frame.position, frame.wxyz = pose.position, np.roll(pose.quaternion(), 1)
        self._struts = scene.add_line_segments(
            "/struts", strut_ends(geometry, home), strut_colours(None), thickness=thick
        )
        self._text = self._server.gui.add_html("")
        self._shown = ""
        self.show(View())

    def close(self) -> None:
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints a message
            self._server.stop()

    def show(self, view: View) -> None:
        """Show a view; if it has no platform pose, the machine is shown at its last known pose with grey struts."""
        server = self._server
        with server.atomic():
            if view.platform is not None:
                self._struts.points = strut_ends(self._geometry, view.platform).astype(np.float32)
                self._platform.position = view.platform.position
                self._platform.wxyz = np.roll(view.platform.quaternion(), 1)
            alive = view.platform is not None
            self._struts.colors = strut_colours(view.corrections if alive else None)
            text = view_html(view, self._geometry.name)
            if text != self._shown:
                self._text.content = self._shown = text

    def _camera(self) -> None:
        ends = strut_ends(self._geometry, self._geometry.home).reshape(-1, 3)
        self._server.scene.set_up_direction("+z")
        centre = 0.5 * (ends.min(axis=0) + ends.max(axis=0))
        distance = 1.3 * float(np.linalg.norm(np.ptp(ends, axis=0)))
        view = self._server.initial_camera
        view.position = centre + distance * np.array([0.8, -0.6, 0.35])
        view.look_at = centre


def strut_ends(geometry: HexapodGeometry, platform: Pose) -> np.ndarray:
    """Return the positions of both ends of each strut in ``base``, m, shape (6, 2, 3)."""
    tops = platform.transform(geometry.platform_joints)
    return np.stack([geometry.base_joints, tops], axis=1)


def strut_colours(corrections: np.ndarray | None) -> np.ndarray:
    """Return an RGB colour, 0 to 255, for each end of each strut: by its correction, m, or UNKNOWN for None."""
    if corrections is None:
        return np.full((6, 2, 3), UNKNOWN, dtype=np.uint8)
    colours = [correction_colour(correction) for correction in corrections]
    return np.array([[[round(255 * c) for c in (colour.r, colour.g, colour.b)]] * 2 for colour in colours], np.uint8)


def view_html(view: View, machine: str) -> str:
    """Return a view as HTML; the template escapes the texts of messages."""
    nodes = []
    for name, title in zip(NODES, ("Compensator", "Drive"), strict=True):
        status = view.states.get(name)
        values = {} if status is None else {entry.key: entry.value for entry in status.values}
        rows = [(shown, values[key]) for key, shown in KEYS.items() if values.get(key)]
        rows += [(f"refused: {key[8:]}", text) for key, text in values.items() if key.startswith("refused.")]
        nodes.append((title, status, SILENT if status is None else COLOURS.get(status.level, SILENT), rows))
    errors = {
        "without compensation, predicted by the model": view.predicted,
        "with compensation, by tool_pose_estimate": view.left,
        "with compensation, by tool_pose_true": view.seen,
    }
    nothing = ["–"] * 6
    measured = nothing if view.measured is None else [f"{1e3 * value:.4f} mm" for value in view.measured]
    corrections = nothing if view.corrections is None else [f"{1e6 * value:+.1f} µm" for value in view.corrections]
    latency = "no commands"
    if view.delays:
        latency = f"median {1e3 * np.median(view.delays):.2f} ms, largest {1e3 * max(view.delays):.2f} ms"
        latency += f", of {len(view.delays)} commands in {WINDOW:g} s"
    return render(
        "watch.html",
        machine=machine,
        nodes=nodes,
        silent=SILENT,
        error=COLOURS[ERROR],
        errors=[(name, _error(error)) for name, error in errors.items()],
        struts=list(zip(measured, corrections, strict=True)),
        latency=latency,
    )


def _error(error: WatchedError | None) -> tuple[str, str, str] | None:
    if error is None:
        return None
    x, y, z = 1e6 * error.displacement
    spread = f" ± {1e6 * error.deviation:.1f}" if np.isfinite(error.deviation) else ""
    length = 1e6 * float(np.linalg.norm(error.displacement))
    return f"{length:.1f}{spread} µm", f"{1e6 * error.turn:.0f} µrad", f"{x:+.1f}, {y:+.1f}, {z:+.1f} µm"


def _outline(joints: np.ndarray) -> np.ndarray:
    """Return the end points, shape (6, 2, 3), m, of the segments of a closed line through six joints."""
    return np.stack([joints, np.roll(joints, -1, axis=0)], axis=1)


def same_site(headers: Mapping[str, str], host: str) -> bool:
    """Return whether an HTTP request comes from a page of this server, or names no page from which it comes.

    Pages of other sites that the user visits can send requests to this server, also under a host name of their own (DNS
    rebinding). So the request's header Host must be an IP address, a name of this computer or `host`, and the header
    Origin, if the request has one, must equal Host.
    """
    requested = headers.get("Host") or ""
    try:
        name = urlsplit(f"//{requested}").hostname or ""
    except ValueError:  # such as an unclosed bracket in the header
        return False
    own = {"localhost", host.lower(), socket.gethostname().lower(), f"{socket.gethostname().lower()}.local"}
    if name not in own:
        try:
            ip_address(name)
        except ValueError:
            return False
    origin = headers.get("Origin")
    return origin is None or origin.lower() in (f"http://{requested}".lower(), f"https://{requested}".lower())


@contextlib.contextmanager
def _own_pages_only(host: str) -> Iterator[None]:
    """Context in which every new websockets server refuses other sites' requests; viser 1.1 has no option for this."""
    from websockets.asyncio import server

    serve = server.serve

    def guarded(*arguments: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            if not same_site(request.headers, host):
                return connection.respond(HTTPStatus.FORBIDDEN, "requests from other sites are refused\n")
            return process_request(connection, request)

        return serve(*arguments, process_request=check, **options)

    server.serve = guarded  # type: ignore[assignment, misc, unused-ignore]
    try:
        yield
    finally:
        server.serve = serve  # type: ignore[misc, unused-ignore]


def _serve(host: str, port: int) -> Any:
    """Start a viser server with an empty page; raise a HexapodError if viser or the address is not available.

    Unlike viser's default, a busy port is an error, there is no public tunnel, and other sites' requests are refused.
    """
    try:
        from viser import ViserServer
    except ImportError as error:
        text = "watching needs viser, which is not installed: pip install viser"
        raise HexapodError(text) from error
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        socket.create_server((host, port), family=family).close()
    except (OSError, OverflowError) as error:
        raise HexapodError(f"cannot serve on {host}, port {port}: {error}; change --host or --port") from error

    class PrivateServer(ViserServer):  # type: ignore[misc, unused-ignore]
        def request_share_url(self, verbose: bool = True) -> None:
            """Open no public tunnel to this page, unlike the same method of viser."""

    # browsers open connections and do not use them, which websockets would log
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    with contextlib.redirect_stdout(io.StringIO()), _own_pages_only(host):  # viser prints a message
        server = PrivateServer(host=host, port=port, verbose=False)
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="large")
    return server
