"""Databrokers for the test: a strict one, and the real databroker if PACKWATCH_DATABROKER names its program.

The strict broker is built from kuksa-client's published stubs. It records each violation of the protocol by the
provider.
"""

import concurrent.futures
import contextlib
import json
import os
import queue
import random
import subprocess
import threading
import time
from pathlib import Path

import grpc
from kuksa.val.v1 import types_pb2 as types_v1
from kuksa.val.v1 import val_pb2 as val_v1
from kuksa.val.v1 import val_pb2_grpc as rpc_v1
from kuksa.val.v2 import types_pb2 as types_v2
from kuksa.val.v2 import val_pb2 as val_v2
from kuksa.val.v2 import val_pb2_grpc as rpc_v2

TYPES = {name: number for number, name in enumerate(
    "string boolean int8 int16 int32 int64 uint8 uint16 uint32 uint64 float double".split(), start=1)}
FIELDS = {"string": "string", "boolean": "bool", "uint8": "uint32", "uint16": "uint32", "uint32": "uint32", "uint64": "uint64", "float": "float",
          "double": "double", "string[]": "string_array", "boolean[]": "bool_array", "float[]": "float_array"}


def type_number(name: str) -> int:
    return TYPES[name[:-2]] + 19 if name.endswith("[]") else TYPES[name]


def leaves(files: list[Path]) -> dict[str, dict]:
    """Every signal of VSS files, by path. The first file that contains a signal counts, as in the databroker."""
    found: dict[str, dict] = {}

    def walk(path: str, node: dict) -> None:
        if node["type"] == "branch":
            for name, child in node["children"].items():
                walk(f"{path}.{name}", child)
        else:
            found.setdefault(path, node)

    for file in files:
        for name, node in json.loads(file.read_text()).items():
            walk(name, node)
    return found


class StrictBroker:
    """Serves kuksa.val.v2 for a provider and for readers, and kuksa.val.v1 for readers. Aborts a call at its first
    violation."""

    def __init__(self, port: int, files: list[Path], token: str | None = None, tls: tuple[bytes, bytes] | None = None,
                 twins: tuple[str, str] | None = None, is_stalled: bool = False):
        self.nodes = leaves(files)
        ids = random.sample(range(1, 100_000), len(self.nodes))
        self.ids = dict(zip(self.nodes, ids))
        if twins:
            self.ids[twins[0]] = self.ids[twins[1]]
        self.paths = {number: path for path, number in self.ids.items()}
        self.points: dict[str, types_v2.Datapoint] = {path: types_v2.Datapoint() for path in self.nodes}
        self.token = token
        self.violations: list[str] = []
        self.batches = 0
        self.listed = False
        self.may_read = threading.Event()
        if not is_stalled:
            self.may_read.set()
        self.changed = threading.Condition()
        self.provider: "queue.Queue | None" = None
        self.answers: queue.Queue = queue.Queue()
        # Held while a request waits for its answer, because databroker 0.7 accepts no values during this time.
        self.lock = threading.Lock()
        self.pool = concurrent.futures.ThreadPoolExecutor(max_workers=16)
        # A fixed window of 64 KiB limits what a provider can send while the broker does not read.
        options = [("grpc.so_reuseport", 0), ("grpc.http2.bdp_probe", 0), ("grpc.http2.lookahead_bytes", 65_536)]
        self.server = grpc.server(self.pool, options=options)
        rpc_v2.add_VALServicer_to_server(V2(self), self.server)
        rpc_v1.add_VALServicer_to_server(V1(self), self.server)
        address = f"127.0.0.1:{port}"
        if tls:
            self.server.add_secure_port(address, grpc.ssl_server_credentials([tls]))
        else:
            self.server.add_insecure_port(address)
        self.server.start()

    def stop(self) -> None:
        self.may_read.set()
        self.server.stop(grace=0).wait()
        self.pool.shutdown(wait=False, cancel_futures=True)

    def check_token(self, context) -> None:
        if self.token and dict(context.invocation_metadata()).get("authorization") != f"Bearer {self.token}":
            context.abort(grpc.StatusCode.UNAUTHENTICATED, "Unauthenticated")

    def violate(self, context, text: str) -> None:
        self.violations.append(text)
        context.abort(grpc.StatusCode.INVALID_ARGUMENT, text)

    def metadata(self, path: str) -> types_v2.Metadata:
        node = self.nodes[path]
        entry = types_v2.Metadata(path=path, id=self.ids[path], data_type=type_number(node["datatype"]), entry_type=2)
        for key in ("min", "max"):
            if key in node:
                setattr(getattr(entry, key), FIELDS[node["datatype"]], node[key])
        if "allowed" in node:
            entry.allowed_values.string_array.values.extend(node["allowed"])
        return entry

    def fault(self, path: str, point: types_v2.Datapoint) -> str | None:
        """Returns what is wrong with a data point of this path, or None."""
        node = self.nodes[path]
        if not point.HasField("timestamp") or abs(point.timestamp.seconds - time.time()) > 60:
            return f"{path}: no current time stamp"
        field = point.value.WhichOneof("typed_value")
        if field is None:
            return None
        if field != FIELDS[node["datatype"]]:
            return f"{path}: {field} for {node['datatype']}"
        value = getattr(point.value, field)
        for number in getattr(value, "values", [value]):
            if isinstance(number, float) and not abs(number) < 3.5e38:
                return f"{path}: {number}"
            if number == "" or ("min" in node and not node["min"] <= number <= node["max"]):
                return f"{path}: {number} is not allowed"
        if node["datatype"] == "uint16" and value > 0xFFFF:
            return f"{path}: {value} in 16 bits"
        return None

    def publish(self, points, claimed: set[int], context) -> None:
        for number, point in points.items():
            if number not in claimed:
                self.violate(context, f"id {number} is not claimed")
            if fault := self.fault(self.paths[number], point):
                self.violate(context, fault)
        with self.changed:
            for number, point in points.items():
                self.points[self.paths[number]].CopyFrom(point)
            self.batches += 1
            self.changed.notify_all()


class V2(rpc_v2.VALServicer):
    def __init__(self, broker: StrictBroker):
        self.broker = broker

    def ListMetadata(self, request, context):
        self.broker.check_token(context)
        root = request.root
        found = [path for path in self.broker.nodes if path == root or path.startswith(root + ".")]
        if not found:
            context.abort(grpc.StatusCode.NOT_FOUND, "Specified root branch does not exist")
        self.broker.listed = True
        return val_v2.ListMetadataResponse(metadata=[self.broker.metadata(path) for path in found])

    def OpenProviderStream(self, requests, context):
        broker = self.broker
        broker.check_token(context)
        if not broker.listed:
            broker.violate(context, "ids used without ListMetadata")
        outgoing: queue.Queue = queue.Queue()
        threading.Thread(target=self.read, args=(requests, context, outgoing), daemon=True).start()
        try:
            while (message := outgoing.get()) is not None:
                yield message
        finally:
            broker.provider = None

    def read(self, requests, context, outgoing) -> None:
        broker, claimed = self.broker, set()
        try:
            for request in requests:
                action = request.WhichOneof("action")
                if action == "provide_signal_request":
                    with broker.lock:
                        claimed |= set(request.provide_signal_request.signals_sample_intervals)
                    if unknown := claimed - set(broker.paths):
                        broker.violate(context, f"unknown ids {unknown}")
                    broker.provider = outgoing
                    outgoing.put(val_v2.OpenProviderStreamResponse(provide_signal_response=val_v2.ProvideSignalResponse()))
                    broker.may_read.wait()
                elif action == "publish_values_request":
                    with broker.lock:
                        broker.publish(request.publish_values_request.data_points, claimed, context)
                elif action == "get_provider_value_response":
                    answer = request.get_provider_value_response
                    for number, point in answer.entries.items():
                        if number not in claimed or broker.fault(broker.paths[number], point):
                            broker.violate(context, f"answer for id {number}")
                    broker.answers.put(answer)
                else:
                    broker.violate(context, f"unexpected {action}")
        except Exception:  # the call ended or was aborted above
            pass
        outgoing.put(None)

    def GetValue(self, request, context):
        """Like databroker 0.7, returns the provider's answer. After a second without an answer, returns the stored
        value.

        A late answer is mistaken for the answer to the next request.
        """
        broker = self.broker
        broker.check_token(context)
        path = request.signal_id.path
        with broker.lock:
            if (provider := broker.provider) is not None:
                question = val_v2.GetProviderValueRequest(request_id=0, signal_ids=[broker.ids[path]])
                provider.put(val_v2.OpenProviderStreamResponse(get_provider_value_request=question))
                with contextlib.suppress(queue.Empty):
                    return val_v2.GetValueResponse(data_point=next(iter(broker.answers.get(timeout=1).entries.values())))
            return val_v2.GetValueResponse(data_point=broker.points[path])

    def Subscribe(self, request, context):
        broker = self.broker
        broker.check_token(context)
        batches = None
        while context.is_active():
            with broker.changed:
                if not broker.changed.wait_for(lambda: broker.batches != batches, timeout=0.2):
                    continue
                batches = broker.batches
                entries = {path: types_v2.Datapoint() for path in request.signal_paths}
                for path, point in entries.items():
                    point.CopyFrom(broker.points[path])
            yield val_v2.SubscribeResponse(entries=entries)


class V1(rpc_v1.VALServicer):
    def __init__(self, broker: StrictBroker):
        self.broker = broker

    def Get(self, request, context):
        self.broker.check_token(context)
        response = val_v1.GetResponse()
        with self.broker.changed:
            for asked in request.entries:
                entry = response.entries.add(path=asked.path)
                point = self.broker.points[asked.path]
                field = point.value.WhichOneof("typed_value")
                if field is None:
                    continue
                entry.value.timestamp.CopyFrom(point.timestamp)
                value = getattr(point.value, field)
                if hasattr(value, "values"):
                    getattr(entry.value, field).values.extend(value.values)
                    getattr(entry.value, field).SetInParent()
                else:
                    setattr(entry.value, field, value)
        return response

    def GetServerInfo(self, _request, context):
        return val_v1.GetServerInfoResponse(name="strict", version="0")


class RealBroker:
    """The databroker's program."""

    violations: list[str] = []

    def __init__(self, port: int, files: list[Path], key: Path | None = None, tls: tuple[Path, Path] | None = None,
                 unix: Path | None = None):
        command = [os.environ["PACKWATCH_DATABROKER"], "--address", "127.0.0.1", "--port", str(port), "--vss", ",".join(map(str, files))]
        command += ["--jwt-public-key", str(key)] if key else ["--disable-authorization"]
        command += ["--tls-cert", str(tls[0]), "--tls-private-key", str(tls[1])] if tls else ["--insecure"]
        command += ["--unix-socket", str(unix)] if unix else []
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self.nodes = leaves(files)

    def stop(self) -> None:
        self.process.terminate()
        try:
            self.process.wait(5)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
