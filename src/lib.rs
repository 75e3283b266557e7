//! packwatch: streaming battery health monitoring over SocketCAN.
//!
//! # Map
//! Each folder under `src` is a crate, so the compiler enforces which crates a crate may use. Only `src/cli` is a
//! module of this crate. A folder inside a crate is a module. A module uses only modules above it in this table
//! (`tests/integration/layering.rs` checks this rule).
//!
//! | crate | module | content |
//! | --- | --- | --- |
//! | `src/core` | [`quantity`] | time, cell numbers, faults, conventions of sign and unit |
//! | | [`filter`] | unscented and linear Kalman filters, vector arithmetic: pure numbers |
//! | | [`can`] | frame, signal, DBC, decode, encode, end-to-end protection, rate limit, ISO-TP and diagnostics, J1939 |
//! | | [`sample`] | plausibility of readings, alignment of values with different times and rates |
//! | | [`cell`] | equivalent circuit, thermal model, estimators of one cell and of a whole pack |
//! | | [`health`] | charge/discharge transitions, capacity, recharge period, usable capacity, remaining life |
//! | | [`cell_faults`] | comparison of each cell with its pack: leaks, contacts, weak cells, channels |
//! | | [`alarm`] | alarm rules over named values, debounce, hysteresis, latch |
//! | | [`monitor`] | combines the stages above: `Record` in, `Outputs` out, snapshot and restore |
//! | | [`sim`] | simulated truth, sensor errors, scenarios |
//! | | [`wiring`] | evidence from signal values (`evidence`); checks wiring and configuration against recorded frames |
//! | `src/regress` | `regress` | Gaussian process regression: pure numbers (feature `lab`) |
//! | `src/host` | `bounded_file` | reads files of limited size: configurations, DBC files, cell models, states, keys |
//! | | [`config`] | TOML to validated settings; reports all faults at once |
//! | | [`io`] | log files, CSV, CAN sockets, clock, journal, result and event files |
//! | | [`logging`] | log lines |
//! | | [`control`] | command socket |
//! | | [`store`] | learned state in two files, history in SQLite |
//! | | [`status`] | status document, metrics |
//! | | [`service`] | the live loop: interfaces, ticks, readiness, reload, watchdog |
//! | | `http` | HTTP server of the exporter and of the uplink |
//! | | [`exporter`] | live page, metrics for Prometheus |
//! | | [`replay`] | the loop over recorded logs |
//! | | [`wiring_check`] | the two loops of `packwatch doctor`: over logs and over live input |
//! | | `failure` | text and exit code of a failed command, for every program |
//! | `src/lab` | `lab` | fit, score, remaining life, Gaussian processes, reports, passports, what-if, export, fleets, plots, import, discover (feature `lab`) |
//! | `src/uplink` | `mqtt`, `kuksa`, `sovd`, `vss` | program `packwatch-uplink`, separate from the vehicle's program: sends the status to MQTT brokers, a KUKSA databroker and SOVD testers |
//! | `src/python` | `python` | the Python module: the library as classes and functions; stubs and Python code are in its folder `packwatch` |
//! | `src/cli` | [`cli`] | one file (and folder) per command with the command's name; `common` holds what commands share; `main.rs` only calls [`cli`] |
//!
//! # The path of a frame
//! `host/io/socket` receives the frame, and `host/service/live.rs` passes it to the [`monitor`]. The stages are
//! `intake` (protection, rate limit) → `can/decode` (for a diagnostic answer: `can/isotp`, `can/uds`) → `sampling` →
//! `estimation` ([`cell`]) → `learning` ([`health`]) → `alarming` ([`alarm`]) → `sending` (`can/encode`). A replay
//! starts at `host/replay.rs`; from the monitor on, the path is the same.
//!
//! # Where to change what
//! Paths are relative to `src`; paths that begin with `/` are relative to the repository.
//!
//! | change | file |
//! | --- | --- |
//! | a new alarm rule | `core/alarm/rule.rs` (table of the rules) |
//! | the value of a rule about inputs | `core/monitor/stages/watch.rs` |
//! | the value of a rule about learned values | `core/monitor/stage/learning.rs` |
//! | the value of a rule about cell comparison | `core/monitor/stage/findings.rs` |
//! | debounce, hysteresis, latch of an alarm | `core/alarm/machine.rs` (states), `core/alarm/limit.rs` (thresholds) |
//! | a new event | `core/monitor/message/event.rs` |
//! | a value in a sent frame | `/config/packwatch.dbc` (written by hand, compiled in), then `core/can/encode/output.rs` |
//! | the order and repetition of sent alarms | `core/monitor/stage/sending/alarm_queue.rs`, `/docs/src/ecu/contract.md` (contract with receivers) |
//! | an end-to-end profile | `core/can/e2e.rs` (profiles, checksums), `core/can/e2e/receiver.rs` (states), `host/config/schema/keys/choices.rs` (name in TOML) |
//! | layout and freshness of authenticated commands | `core/can/secoc.rs` (layout), `core/can/secoc/window.rs` (freshness) |
//! | which authenticated commands are executed | `core/monitor/stage/intake/command_gate.rs` |
//! | the key of the authentication | `host/io/can_key.rs` |
//! | detection of a second sender of a message | `core/can/rate.rs` |
//! | detection of foreign frames with our own identifiers | `core/can/own_frames.rs` |
//! | detection of a frozen current | `core/sample/frozen.rs` |
//! | upper bounds of external numbers | `core/quantity/bounds.rs` |
//! | ISO-TP | `core/can/isotp.rs` |
//! | decoding of diagnostic answers | `core/can/uds.rs` |
//! | which diagnostic requests are sent, and when | `core/can/poll.rs` |
//! | detection of bus sleep | `core/monitor/stage/sleep.rs` |
//! | plausibility of a reading | `core/sample/signal.rs` |
//! | the filter's process or measurement noise | `core/cell/estimator/bank/kernel/predict.rs`, `core/cell/estimator/bank/kernel/update.rs` |
//! | the open-circuit curve of an aged cell | `core/cell/aged_ocv.rs` |
//! | half-cell potentials | `core/cell/electrodes.rs` (library), `lab/ident/electrodes.rs` (fit) |
//! | the model learned on board | `core/cell/own_model/fit.rs` (fit), `core/monitor/stage/modelling.rs` (time of a fit), `host/service/live.rs` (thread of the fit) |
//! | the signature of a cell fault | `core/cell_faults/difference.rs`, `core/cell_faults/channels.rs` |
//! | when a cell fault is reported | `core/cell_faults/fault.rs` |
//! | capacity learned from a half-cycle | `core/health/learner.rs` |
//! | how a pack is used: limits, C-rates, fast charges | `core/health/use_record.rs` (counters), `core/monitor/stages/use_record.rs` (values, limits) |
//! | learned values of packs that were exchanged | `core/monitor/stages/pack_memory.rs` |
//! | contents of the stored state | the state of the stage, `core/monitor/snapshot.rs`, `core/monitor/lifecycle/restore.rs` (restore) |
//! | a configuration key | `host/config/schema/keys/` (files `pack`, `input`, `limits`, `algorithms`, `traffic`), `host/config/mod.rs` (list of the steps) |
//! | discovery and merging of drop-ins | `host/config/document/source.rs`, `host/config/document/merge.rs` |
//! | identity of the vehicle | `host/config/result/vehicle.rs` |
//! | a published number of pack or cell (status, metrics, MQTT, VSS) | `core/quantity/catalogue/table.rs` (row), `core/monitor/view.rs` (value) |
//! | another status field | `host/status/document.rs` (type), `host/status/collect.rs` (value), `cli/status` (screen) |
//! | another metric | `host/status/metrics.rs` |
//! | another MQTT entity | `uplink/mqtt/entity.rs` |
//! | MQTT topics | `uplink/mqtt/mod.rs` |
//! | the queue for a lost MQTT link | `uplink/mqtt/queue.rs` |
//! | another VSS signal, standard or overlay | `uplink/kuksa/signals/derived.rs` (`packwatch vss --reference` prints the manual page) |
//! | order of values sent to the databroker | `uplink/kuksa/outgoing.rs` |
//! | a history table or column | `host/store/rows.rs`, `host/store/database.rs` (tables of packs, moments and segments) |
//! | the files of the stored state | `host/store/state_files.rs` |
//! | when a checkpoint is due | `host/store/checkpoint.rs` |
//! | verification and retention of the history | `host/store/segments.rs` |
//! | values restored from the history at start | `host/store/learned.rs`, `core/monitor/lifecycle/relearn.rs` |
//! | a command over the control socket | `host/control/protocol.rs` |
//! | a log format | `host/io/log.rs`, `host/io/candump/parser.rs` (lines of candump) |
//! | a log format of another tool | `formats/text/NAME.rs` (text formats), `formats/format.rs` (recognition) |
//! | segments of a recording | `host/io/segments.rs` |
//! | a column of `replay --estimates` | `host/replay/rows.rs` |
//! | a column of `export` (Parquet, CSV) | `lab/fleet/export/columns.rs` |
//! | conversion of an OBDb signal set | `lab/import/obdb.rs`, `lab/import/obdb/signal.rs` (one signal) |
//! | conversion of a BPX file | `lab/import/bpx/curve.rs` (open-circuit voltage), `lab/import/bpx/circuit.rs` (resistances) |
//! | signals that `discover` proposes, and the reasons | `lab/discover/judge.rs` (points), `core/wiring/evidence/label.rs` (names, units) |
//! | fields without a definition that `discover` proposes | `lab/discover/raw.rs` (in answers), `lab/discover/fields.rs` (in messages) |
//! | a finding of the doctor | `core/wiring/judge` |
//! | uncertainty of a cell model, advised measurement | `core/cell/model_bands.rs`, `core/cell/model_bands/advice.rs` |
//! | contents of a cell model file | `host/config/cell_model/keys.rs` (keys), `host/config/cell_model/read.rs` (reading), `host/config/cell_model/write.rs` (writing) |
//! | a plot of a cell model | `lab/model_pictures.rs` |
//! | a section or plot of the report | `lab/report/html.rs` (sections), `lab/report/pictures.rs` (plots), `lab/report/summary.rs` (headline and cards) |
//! | a value of a battery passport | `lab/passport/field.rs` (place in a standard), `lab/passport/condition.rs` (value) |
//! | requirements of a passport standard | `lab/passport/standards.rs` |
//! | a fuzz target, or an invariant that it checks | `/fuzz/src/doors`, `/fuzz/seeds` (seeds and past failures) |
//! | allowed dependencies | `/deny.toml` |
//! | the bill of materials | `/packaging/debian/sbom` |
//! | reproducible builds | `/packaging/debian/build` |
//! | files of a package | `/packaging/tree` |
//! | program and processor of a package | `/packaging/program`, `/packaging/architectures` |
//! | the build of all packages | `/packaging/packages` |
//! | a command or its options | `cli/COMMAND.rs`, or `cli/COMMAND/args.rs` where that exists |
//! | options of a score, its tables and document | `lab/score/request.rs` (options), `lab/score/report.rs` (tables, document), `lab/single_cell.rs` (configuration of the cell) |
//! | a column of a CSV log or measured file, the Battery Data Format | `host/io/csv_log.rs` |
//! | a column of a capacity table (history, cycles, truth, reference) | `lab/capacity_table.rs` |
//! | a class or function of the Python module | `python/NAME.rs` (code), `python/packwatch/_packwatch.pyi` (types) |
//!
//! # Invariants
//! * `src/core` and `src/regress` never read a clock, a file or a socket and never log: the same inputs give the same
//!   outputs, byte for byte.
//! * In the core, current is positive for discharge and SOC is a fraction; only [`can`] handles the signs and units of
//!   signals.
//! * A bad reading is passed on, marked with its fault. An unknown value never looks healthy.

pub use packwatch_core::{alarm, can, cell, cell_faults, filter, health, monitor, quantity, sample, sim, wiring};
pub use packwatch_host::{config, control, exporter, io, logging, replay, service, status, store, wiring_check};
#[cfg(feature = "lab")]
pub use packwatch_lab::{self as lab, ident};
#[cfg(feature = "lab")]
pub use packwatch_regress as regress;

pub mod cli;
