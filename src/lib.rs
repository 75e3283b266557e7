//! packwatch: streaming battery health monitoring over SocketCAN.
//!
//! # Map
//! One folder under `src` is one crate, so that the compiler enforces what may use what; a folder inside is one room. Rooms use
//! only rooms above them in this table (`tests/integration/layering.rs` checks it).
//!
//! | crate | room | what lives there |
//! | --- | --- | --- |
//! | `src/core` | [`quantity`] | time, cell numbers, faults, conventions of sign and unit |
//! | | [`filter`] | unscented and linear Kalman filters, vector arithmetic: pure numbers |
//! | | [`can`] | frame, signal, DBC, decode, encode, end-to-end protection, flood limit, ISO-TP and diagnostics, J1939 |
//! | | [`sample`] | plausibility of readings, alignment of values of different times and rates |
//! | | [`cell`] | equivalent circuit, thermal model, estimator of one cell and of a whole pack at once |
//! | | [`health`] | charge/discharge transitions, capacity, recharge period, usable capacity, remaining life |
//! | | [`cell_faults`] | each cell against its pack: leaks, contacts, weak cells, channels |
//! | | [`alarm`] | alarm rules over named values, debounce, hysteresis, latch |
//! | | [`monitor`] | wires the stages above: `Record` in, `Outputs` out, snapshot and restore |
//! | | [`sim`] | simulated truth, sensor errors, scenarios |
//! | | [`wiring`] | what signals show of themselves (`evidence`); judges wiring and configuration from the frames of a bus |
//! | `src/regress` | `regress` | Gaussian process regression: pure numbers (feature `lab`) |
//! | `src/host` | [`config`] | TOML to checked settings, all faults at once |
//! | | [`io`] | log files, CSV, CAN sockets, clock, journal, files of results and events |
//! | | [`store`] | learned state in two files, history in SQLite |
//! | | [`status`], [`control`], [`exporter`], [`logging`] | status document, metrics, command socket, Prometheus, log lines |
//! | | [`service`] | the live loop: links, ticks, readiness, reload, watchdog |
//! | | [`replay`], [`wiring_check`] | loops that are no service: recorded logs, the doctor |
//! | | `failure` | why a command ended: text and exit code of every program |
//! | `src/lab` | `lab` | fit, score, remaining life, Gaussian processes, reports, passports, what-if, export, fleets, plots, import, discover (feature `lab`) |
//! | `src/uplink` | `mqtt`, `kuksa`, `vss` | program `packwatch-uplink`: the status for MQTT brokers and a KUKSA databroker; no part of the vehicle's program |
//! | `src/python` | `python` | the Python module: the library as classes and functions; stubs and Python code in its folder `packwatch` |
//! | `src/cli` | [`cli`] | one file (and folder) per command, named like it, above `common`, which they share; `main.rs` only calls it |
//!
//! # The path of a frame
//! `host/io/socket` receives it, `host/service/live.rs` passes it on, then [`monitor`]: `intake` (protection, flood) → `can/decode`
//! (a diagnostic answer: `can/isotp`, `can/uds`) → `sampling` → `estimation` ([`cell`]) → `learning` ([`health`]) → `alarming` ([`alarm`]) → `sender` (`can/encode`). A replay enters
//! at `host/replay.rs` instead; all after it is the same.
//!
//! # To change something, open
//! Paths are below `src`, except those that begin with `/`.
//!
//! | change | file |
//! | --- | --- |
//! | a new alarm rule | `core/alarm/rule.rs` (its table row); values that follow from inputs come from `core/monitor/stages/watch.rs`, learned ones from `core/monitor/stage/learning.rs`, those of a cell against its pack from `core/monitor/stage/findings.rs` |
//! | debounce, hysteresis, latch of an alarm | `core/alarm/machine.rs` (states), `core/alarm/limit.rs` (thresholds) |
//! | a new event | `core/monitor/message/event.rs` |
//! | a value in a sent frame | `/config/packwatch.dbc` (written by hand, compiled in), then `core/can/encode/output.rs` |
//! | which alarm is sent when, how often it is repeated | `core/monitor/stage/sending/alarm_queue.rs`; the promise to receivers: `/docs/src/ecu/contract.md` |
//! | an end-to-end profile | `core/can/e2e.rs` (profiles, checksums), `core/can/e2e/receiver.rs` (states); its name in TOML: `host/config/schema/keys/choices.rs` |
//! | authentication: layout and freshness; which commands are executed; the key | `core/can/secoc.rs`, `core/can/secoc/window.rs`; `core/monitor/stage/intake/command_gate.rs`; `host/io/can_key.rs` |
//! | a second sender of a message; frames with our own identifiers; a frozen current | `core/can/rate.rs`; `core/can/own_frames.rs`; `core/sample/frozen.rs` |
//! | what a number can be at most, at every door | `core/quantity/bounds.rs` |
//! | ISO-TP; what is read of a diagnostic answer; what is asked, and when not | `core/can/isotp.rs`; `core/can/uds.rs`; `core/can/poll.rs` |
//! | when the buses sleep | `core/monitor/stage/sleep.rs` |
//! | plausibility of a reading | `core/sample/signal.rs` |
//! | the filter's process or measurement noise | `core/cell/estimator/noise.rs` |
//! | how an aged cell's open-circuit curve changes, a half-cell potential | `core/cell/aged_ocv.rs`, `core/cell/electrodes.rs`; found by `lab/ident/electrodes.rs` |
//! | how a model is learned on board | `core/cell/own_model/fit.rs` (fit), `core/monitor/stage/modelling.rs` (when); on another thread: `host/service/live.rs` |
//! | what a fault of one cell looks like; from when on it is reported | `core/cell_faults/difference.rs`, `core/cell_faults/channels.rs`; `core/cell_faults/finding.rs` |
//! | what a half-cycle teaches of the capacity | `core/health/learner.rs` |
//! | what is kept of exchanged packs | `core/monitor/stages/pack_memory.rs` |
//! | what a stored state holds | the stage's state, `core/monitor/snapshot.rs`; how it is restored: `core/monitor/lifecycle/restore.rs` |
//! | a configuration key | its table in `host/config/schema/keys/` (`pack`, `input`, `limits`, `algorithms`, `traffic`); `host/config/mod.rs` lists the steps |
//! | how drop-ins are found and merged | `host/config/document/source.rs`, `host/config/document/merge.rs` |
//! | what identifies the vehicle | `host/config/result/vehicle.rs` |
//! | a published number of pack or cell: in status, metrics, MQTT, VSS | `core/quantity/catalogue.rs` (its row), `core/monitor/view.rs` (its value) |
//! | another status field | `host/status/document.rs` (type), `host/status/collect.rs` (value); on screen: `cli/status` |
//! | another metric | `host/status/metrics.rs` |
//! | another entity of MQTT; its topics; the queue for a lost link | `uplink/mqtt/entity.rs`; `uplink/mqtt/mod.rs`; `uplink/mqtt/queue.rs` |
//! | another signal of VSS or of its overlay | `uplink/kuksa/signals/derived.rs` (the page: `packwatch vss --reference`) |
//! | what is sent to the databroker in which order | `uplink/kuksa/outgoing.rs` |
//! | a history table or column | `host/store/rows.rs`; tables of packs, moments and segments: `host/store/database.rs` |
//! | the files of the stored state; when a checkpoint is due | `host/store/state_files.rs`; `host/store/checkpoint.rs` |
//! | how the history is verified, and how long it is kept | `host/store/segments.rs` |
//! | what a start takes from the history | `host/store/learned.rs`, `core/monitor/lifecycle/relearn.rs` |
//! | a command over the control socket | `host/control/protocol.rs` |
//! | a log format | `host/io/log.rs`; lines of candump: `host/io/candump/parser.rs` |
//! | segments of a recording | `host/io/segments.rs` |
//! | a column of `replay --estimates` | `host/replay/rows.rs` |
//! | a column of `export` (Parquet, CSV) | `lab/fleet/export/columns.rs` |
//! | what an OBDb signal set becomes | `lab/import/obdb.rs`, one signal: `lab/import/obdb/signal.rs` |
//! | what a BPX file becomes | `lab/import/bpx/curve.rs` (open-circuit voltage), `lab/import/bpx/circuit.rs` (resistances) |
//! | which signals `discover` proposes, and why | `lab/discover/judge.rs` (points), `core/wiring/evidence/label.rs` (names, units); fields without a definition: `lab/discover/raw.rs` (answers), `lab/discover/fields.rs` (messages) |
//! | a finding of the doctor | `core/wiring/judge` |
//! | how well a cell model is known, what measurement is advised | `core/cell/model_bands.rs`, `core/cell/model_bands/advice.rs` |
//! | what a cell model file holds | `host/config/cell_model/keys.rs`, `read.rs` (read), `host/config/cell_model/write.rs` (written) |
//! | a picture of a cell model | `lab/model_pictures.rs` |
//! | a section or plot of the report | `lab/report/html.rs`, `lab/report/pictures.rs`; its headline and cards: `lab/report/summary.rs` |
//! | a value of a battery passport, its place in a standard; what a standard requires | `lab/passport/field.rs`, `lab/passport/condition.rs`; `lab/passport/standards.rs` |
//! | a door that is fuzzed, an invariant of it | `/fuzz/src/doors`; seeds and past failures: `/fuzz/seeds` |
//! | what dependencies may be; the bill of materials; the same bytes | `/deny.toml`; `/packaging/debian/sbom`; `/packaging/debian/build` |
//! | a package: its files; its program and processor; all of them | `/packaging/tree`; `/packaging/program`, `/packaging/architectures`; `/packaging/packages` |
//! | a command or its options | `cli/COMMAND.rs`, or `cli/COMMAND/args.rs` where that exists |
//! | what a score is asked for, its tables and document | `lab/score/request.rs`, `lab/score/report.rs`; the cell's configuration: `lab/single_cell.rs` |
//! | a column of a CSV log or measured file, the Battery Data Format | `host/io/csv_log.rs` (`SampleColumns`) |
//! | a column of a table of capacities (history, cycles, truth, reference) | `lab/capacity_table.rs` |
//! | a class or function of the Python module | `python/NAME.rs`, its type in `python/packwatch/_packwatch.pyi` |
//!
//! # Invariants
//! * `src/core` and `src/regress` never read a clock, a file or a socket and never log: the same inputs give the same outputs, byte
//!   for byte.
//! * Inside, current is positive for discharge, SOC is a fraction; wire units end in [`can`].
//! * A bad reading is data with a fault; an unknown value never looks healthy.

pub use packwatch_core::{alarm, can, cell, cell_faults, filter, health, monitor, quantity, sample, sim, wiring};
pub use packwatch_host::{config, control, exporter, io, logging, replay, service, status, store, wiring_check};
#[cfg(feature = "lab")]
pub use packwatch_lab::{self as lab, ident};
#[cfg(feature = "lab")]
pub use packwatch_regress as regress;

pub mod cli;
