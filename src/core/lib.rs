//! The pure core: turns frames into estimates, alarms and frames. The core never reads a clock, a file or a socket and
//! never logs, and no dependency of this crate does I/O. The same inputs therefore give the same outputs, byte for
//! byte.
//!
//! The driver is the program that feeds the core. It holds the keys for authenticated frames, writes the authenticators
//! into sent frames, and tells the core whether the authenticators of received frames are correct.
//!
//! # Data path
//! [`monitor::Monitor`] handles every record. Data flows in one direction. `monitor/message` defines the records that
//! come in and the events, estimates and frames that go out; it does not depend on any stage. Each file in
//! `monitor/stage` contains one stage and does not depend on later stages. Only `monitor/stages.rs` contains the order
//! of the stages. `monitor/lifecycle` restores and reconfigures the stages.
//!
//! | stage | in → out | file | algorithms |
//! | --- | --- | --- | --- |
//! | intake | frame → readings, command | `monitor/stage/intake.rs` | [`can`]: flood limit, protection, decoding |
//! | sampling | reading → cell sample | `monitor/stage/sampling.rs` | [`sample`]: limits, ages, charge |
//! | estimation | cell samples → estimates | `monitor/stage/estimation/batch.rs`, `monitor/stage/estimation.rs` | [`cell`], [`filter`] |
//! | modelling | filter steps, rest voltages → the cells' own model, learned on board | `monitor/stage/modelling.rs` | [`cell`]: notebook, own model |
//! | findings | cell samples, estimates → findings, values for the rules that compare a cell with its pack | `monitor/stage/findings.rs` | [`cell_faults`]: each cell against its pack |
//! | learning | pack current, estimates → health values | `monitor/stage/learning.rs`, `monitor/stage/learning/life.rs` | [`health`] |
//! | alarming | values → changes of alarms | `monitor/stages/watch.rs`, `monitor/stage/alarming.rs` | [`alarm`] |
//! | sending | alarms, values → frames | `monitor/stage/sending.rs`, `monitor/stage/sending/alarm_queue.rs`, `monitor/stage/sending/digest.rs`, `monitor/stage/sending/j1939.rs` | [`can`]: encoding, J1939 |
//!
//! # Where a change belongs
//! | change | file |
//! | --- | --- |
//! | a new alarm rule | `alarm/rule.rs` (number, unit, direction), `monitor/stages/watch.rs` (its value) |
//! | an alarm's state transition or command | `alarm/machine.rs` (table), `alarm/engine.rs` |
//! | a new event, or a new field of an event | `monitor/message/event.rs` |
//! | a new field of the live view | `monitor/message/view.rs` (type), `monitor/view.rs` |
//! | a new field of a stored state | the stage's state, `monitor/snapshot.rs` |
//! | what is restored when only the history survived | `monitor/lifecycle/relearn.rs` |
//! | a setting that may change while running | `monitor/config.rs`, `monitor/lifecycle/reconfigure.rs` |
//! | a field of a sent frame | `can/encode/output.rs`, `monitor/stages.rs` (its value) |
//! | a field of the digest | `can/encode/digest.rs`, `monitor/stage/sending/digest.rs` |
//! | a field of the reply to a command | `can/encode/reply.rs` |
//! | which alarm is sent when, and how often | `monitor/stage/sending/alarm_queue.rs` |
//! | another end-to-end profile | `can/e2e.rs` |
//! | authentication of frames | `can/secoc.rs` |
//! | which commands are executed | `monitor/stage/intake/command_gate.rs` |
//! | a counter of the record of use | `health/use_record.rs`, `monitor/stages/use_record.rs` (values, limits) |
//! | what is kept about packs that were exchanged | `monitor/stages/pack_memory.rs` |
//! | a plausibility check of a signal | `sample/signal.rs` |
//! | a plausibility check of the current against the voltages | `sample/frozen.rs` |
//! | how a second sender of the same frame is detected | `can/rate.rs`, `can/own_frames.rs` |
//! | a physical bound | `quantity/bounds.rs` |
//! | how a cell ages | `cell/aged_ocv.rs` |
//! | a half-cell potential | `cell/electrodes.rs` |
//! | which data the cells' own model is fitted to | `cell/notebook.rs` |
//! | how the own model is fitted | `cell/own_model/fit.rs` |
//! | when the own model is used | `monitor/stage/modelling.rs` |
//! | a chemistry on the label | `cell/chemistry.rs` |
//! | a kind of finding | `cell_faults/fault.rs` (kind, limit), `cell_faults/detector.rs` (detection) |
//! | a cell's loss of lithium or active material | `cell/loss_modes.rs` |
//! | uncertainty bands of a cell model, which measurement helps most | `cell/model_bands.rs` |
//! | the distance between two cell models | `cell/model_comparison.rs` |
//! | detection of a model that belongs to another cell | `cell/model_check.rs` |
//! | the cell's equations | `cell/circuit.rs`, `cell/estimator.rs`, `cell/estimator/bank/kernel.rs` |
//! | a finding of `doctor` | `wiring/judge/` |
//! | what values, names and bits say about a signal (used by `doctor` and `discover`) | `wiring/evidence/` |
//! | a scenario of the simulator | `sim/scenario.rs` |
//!
//! # Invariants
//! * Internally, current is positive for discharge and SOC is a fraction; only [`can`] deals with wire units.
//! * A bad reading is passed on with its fault. An unknown value never counts as healthy.
//! * If the driver's clock was set back, the elapsed time counts as unknown. A gap in the input does not count towards
//!   the debounce of a measured value, and it interrupts the timing of a recharge period.

pub mod alarm;
pub mod can;
pub mod cell;
pub mod cell_faults;
pub mod filter;
pub mod health;
pub mod monitor;
pub mod quantity;
pub mod sample;
pub mod sim;
pub mod wiring;
