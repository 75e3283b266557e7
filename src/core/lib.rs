//! The pure core: frames in, estimates, alarms and frames out. Never reads a clock, a file or a socket, and never logs: the
//! same inputs give the same outputs, byte for byte. Keys of authenticated frames stay outside: the driver checks and makes
//! authenticators, and passes the outcome in. The crate has no dependency that could do otherwise.
//!
//! # Data path
//! [`monitor::Monitor`] handles every record. Data flows one way: `monitor/message` (records in, events, estimates and frames out) knows no stage; one file under
//! `monitor/stage` is one stage and knows none that comes after it; `monitor/stages.rs` alone knows their order; `monitor/lifecycle` restores,
//! reconfigures and restarts them.
//!
//! | stage | in → out | file | algorithms |
//! | --- | --- | --- | --- |
//! | intake | frame → readings, command | `monitor/stage/intake.rs` | [`can`]: flood limit, protection, decoding |
//! | sampling | reading → cell sample | `monitor/stage/sampling.rs` | [`sample`]: limits, ages, charge |
//! | estimation | cell samples → estimates | `monitor/stage/estimation/batch.rs`, `monitor/stage/estimation.rs` | [`cell`], [`filter`] |
//! | modelling | steps of the cells, rests → the cells' own model | `monitor/stage/modelling.rs` | [`cell`]: notebook, own model |
//! | findings | cell samples, estimates → findings, values of the rules about a cell against its pack | `monitor/stage/findings.rs` | [`cell_faults`]: each cell against its pack |
//! | learning | pack current, estimates → health values | `monitor/stage/learning.rs`, `monitor/stage/learning/life.rs` | [`health`] |
//! | alarming | values → changes of alarms | `monitor/stages/watch.rs`, `monitor/stage/alarming.rs` | [`alarm`] |
//! | sending | alarms, values → frames | `monitor/stage/sending.rs`, `monitor/stage/sending/alarm_queue.rs`, `monitor/stage/sending/digest.rs`, `monitor/stage/sending/j1939.rs` | [`can`]: encoding, J1939 |
//!
//! # Where a change belongs
//! | change | file |
//! | --- | --- |
//! | a new alarm rule | `alarm/rule.rs` (number, unit, direction), `monitor/stages/watch.rs` (its value) |
//! | a transition or command of an alarm | `alarm/machine.rs` (table), `alarm/engine.rs` |
//! | a new event, or a field of one | `monitor/message/event.rs` |
//! | a new field of the live view | `monitor/message/view.rs` (type), `monitor/view.rs` |
//! | a new field of a stored state | the stage's state, `monitor/snapshot.rs` |
//! | what is begun with when only a history is left | `monitor/lifecycle/relearn.rs` |
//! | a setting that may change while running | `monitor/config.rs`, `monitor/lifecycle/reconfigure.rs` |
//! | a field of a sent frame | `can/encode/output.rs`, `monitor/stages.rs` (its value); of the digest `can/encode/digest.rs`, `monitor/stage/sending/digest.rs`; of the reply `can/encode/reply.rs` |
//! | which alarm is sent when, and how often | `monitor/stage/sending/alarm_queue.rs` |
//! | another end-to-end profile | `can/e2e.rs` |
//! | authentication of frames; which commands are executed | `can/secoc.rs`; `monitor/stage/intake/command_gate.rs` |
//! | what is kept of exchanged packs | `monitor/stages/pack_memory.rs` |
//! | a plausibility check of a signal | `sample/signal.rs`; of the current by the voltages: `sample/frozen.rs` |
//! | what counts as a second sender | `can/rate.rs`, `can/own_frames.rs` |
//! | a physical bound | `quantity/bounds.rs` |
//! | how a cell ages, a half-cell potential | `cell/aged_ocv.rs`, `cell/electrodes.rs` |
//! | what is noted for a model; how it is fitted on board; when it is used | `cell/notebook.rs`; `cell/own_model/fit.rs`; `monitor/stage/modelling.rs` |
//! | a chemistry on the label | `cell/chemistry.rs` |
//! | a kind of finding | `cell_faults/fault.rs` (kind, limit), `cell_faults/detector.rs` (its judgement) |
//! | what a cell has lost | `cell/loss_modes.rs` |
//! | bands of a cell model, which measurement helps most | `cell/model_bands.rs` |
//! | how far two cell models are apart | `cell/model_comparison.rs` |
//! | how a model of another cell is found | `cell/model_check.rs` |
//! | the cell's equations | `cell/circuit.rs`, `cell/estimator.rs`, `cell/estimator/bank/kernel.rs` |
//! | a finding of the doctor; what values, names and bits say about a signal (`discover` too) | `wiring/judge/`; `wiring/evidence/` |
//! | a scenario of the simulator | `sim/scenario.rs` |
//!
//! # Invariants
//! * Inside, current is positive for discharge and SOC is a fraction; wire units end in [`can`].
//! * A bad reading is data with a fault; an unknown value never looks healthy.
//! * Time never goes back, and a gap counts for no period.

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
