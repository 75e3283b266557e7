//! The integration tests. They form one program, so that they are compiled and linked once. They work with `cargo
//! nextest run` (one process per test) and with `cargo test` (one process, threads).
//!
//! To run the tests of one module: `cargo test --test integration doctor::`. `tests/allocations.rs` is a separate
//! program because it replaces the global allocator.
#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "tests may panic, and tables and skipped comparisons are printed"
)]

mod alarm_noise;
mod alarm_tradeoff;
mod authentication;
mod bus_sleep;
mod can_data;
mod capacity_peers;
mod cell_rules;
mod check_cli;
mod contactor;
mod contract;
#[cfg(feature = "lab")]
mod convert_cli;
mod dbc_vectors;
mod diagnose_cli;
mod diagnostic;
#[cfg(feature = "lab")]
mod discover_cli;
mod doctor;
mod e2e_peer;
mod examples;
#[cfg(feature = "lab")]
mod export_cli;
mod field_definitions;
mod fit_cli;
mod fit_logs;
mod fit_logs_bad;
#[cfg(feature = "lab")]
mod fleet_cli;
mod fuzz_seeds;
#[cfg(feature = "lab")]
mod gp_measured;
#[cfg(feature = "lab")]
mod gp_peer;
#[cfg(feature = "lab")]
mod gpr_cli;
mod hostile;
#[cfg(feature = "lab")]
mod import_obdb;
mod isotp_peer;
mod layering;
mod life_decodes;
mod log_formats;
mod log_grammar;
mod measured_life;
mod mistakes;
mod model_cli;
mod monitor_alarms;
mod monitor_cuts;
mod monitor_damaged;
mod monitor_properties;
mod monitor_reconfigure;
mod monitor_restart;
mod monitor_scenarios;
mod monitor_statistics;
mod on_board_model;
mod other_cell;
#[cfg(feature = "lab")]
mod outlook_measured;
mod output_dbc;
mod pack_memory;
mod pack_modules;
mod paper_scenario;
#[cfg(feature = "lab")]
mod passport_cli;
mod protected_input;
mod recharge_fleet;
mod reference_scenario;
mod replay_cli;
#[cfg(feature = "lab")]
mod report_cli;
mod restart;
#[cfg(feature = "lab")]
mod rul;
mod sample_measured;
mod score_cli;
mod simulate_cli;
mod spread_rounds;
mod store_cli;
mod support;
mod tables;
mod thermal_event;
mod tuned_constants;
mod uplink_cli;
#[cfg(feature = "lab")]
mod use_record;
#[cfg(feature = "lab")]
mod whatif_cli;
mod yocto_recipe;
