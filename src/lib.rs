//! packwatch: streaming battery health monitoring over SocketCAN.
//!
//! # Map
//! A lower layer never names a higher one; `tests/integration/layering.rs` holds the code to this table.
//!
//! | layer | module | what lives there |
//! | --- | --- | --- |
//! | 0 | [`quantity`] | time, cell numbers, faults, conventions of sign and unit |
//! | 1 | [`filter`] | unscented and linear Kalman filters, arithmetic of several lanes: pure numbers |
//! | 1 | `regress` | Gaussian process regression: pure numbers (feature `lab`) |
//! | 1 | [`can`] | frame, signal layout, decode, encode, end-to-end protection, bound on frames, J1939 |
//! | 2 | [`sample`] | plausibility, alignment of values of different times and rates |
//! | 2 | [`cell`] | equivalent circuit, thermal model, estimator of one cell and of a whole pack at once |
//! | 2 | [`health`] | transitions, capacity, recharge period, usable capacity, remaining life |
//! | 2 | [`alarm`] | rules over named values, the life of an alarm |
//! | 3 | [`monitor`] | the core's one face: `Input` in, `Outputs` out, snapshot and restore |
//! | 3 | [`sim`] | truth model, sensor errors, scenarios |
//! | 3 | [`doctor`] | what is probably wrong with the wiring or the configuration, from what comes over the bus |
//! | 3 | `ident` | fit of cell models to measured data (feature `lab`) |
//! | 4 | [`config`] | TOML to checked settings, all faults at once |
//! | 5 | [`io`], [`store`], [`status`], [`service`] | log files, sockets, clock, service, state and history, control and status sockets, exporter |
//! | 5 | `lab` | measured files against truth, remaining life of capacity histories, Gaussian processes on files, plots (feature `lab`) |
//! | 6 | [`cli`] | one file per command |
//!
//! # Invariants
//! * Layers 0 to 3 never read a clock, a file or a socket and never log: the same inputs give the same outputs, byte for byte.
//! * Inside, current is positive for discharge, SOC is a fraction; wire units end in [`can`].
//! * A bad reading is data with a fault; nothing unknown looks healthy.

pub use packwatch_core::{alarm, can, cell, doctor, filter, health, monitor, quantity, sample, sim};
pub use packwatch_host::{config, control, diagnosis, exporter, io, logging, replay, service, status, store};
#[cfg(feature = "lab")]
pub use packwatch_lab::{self as lab, ident};
#[cfg(feature = "lab")]
pub use packwatch_regress as regress;

pub mod cli;
