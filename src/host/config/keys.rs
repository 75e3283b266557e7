//! Every key of the configuration file: meaning, type, unit, range and default, once.
//!
//! A new key is one line here and one where `convert` turns it into a setting. The reference page
//! (`config/REFERENCE.md`) and every fault's "must be" come from these lines.

mod traffic;

use super::alarm::Threshold;
use super::schema::Presence::{Default, Optional, Required};
use super::schema::{SectionInfo, section};
use super::setting::Allowed::{Above, Any, Between, NotEmpty};
use super::setting::{CellRanges, choice};
use crate::alarm::{Comparison, Rule};
use crate::can::e2e::Profile;
use crate::cell::{CapacityState, Discretisation};
use crate::health::RechargeAlarm;
use crate::quantity::MAX_CELLS;

pub(super) use traffic::{Commands, FrameKeys, J1939, Output, OutputAlarm, OutputHealth, OutputStatus};

/// Coldest and hottest temperature anybody may configure, degrees C.
const TEMPERATURE_C: super::setting::Allowed = Between(-100.0, 200.0);
/// Standard deviations and densities.
const DEVIATION: super::setting::Allowed = Between(0.0, 1e6);

/// Which way a positive current flows on the bus.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Positive {
    /// Into the pack.
    Charge,
    /// Out of the pack.
    Discharge,
}

/// Where the capacity measurement of a half-cycle comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Method {
    /// Charge over the swing the voltages tell.
    Swing,
    /// Charge over a nominal swing.
    Nominal,
}

/// End-to-end protection of a frame: off, or the AUTOSAR profile.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum E2e {
    /// None.
    Off,
    /// Profile 1, variant A.
    P01A,
    /// Profile 1, variant C.
    P01C,
    /// Profile 5.
    P05,
}

choice!(Positive { "charge" => Self::Charge, "discharge" => Self::Discharge });
choice!(Method { "swing" => Self::Swing, "nominal" => Self::Nominal });
choice!(E2e { "off" => Self::Off, "1A" => Self::P01A, "1C" => Self::P01C, "5" => Self::P05 });
choice!(Discretisation { "exact" => Self::Exact, "euler" => Self::Euler });
choice!(CapacityState { "joint" => Self::Joint, "held" => Self::Held });
choice!(RechargeAlarm { "raw" => Self::Raw, "normalised" => Self::Normalised });
choice!(Profile { "1A" => Self::P01A, "1C" => Self::P01C, "5" => Self::P05 });
choice!(Rule {
    "capacity_low" => Self::CapacityLow,
    "usable_capacity_low" => Self::UsableCapacityLow,
    "recharge_period_low" => Self::RechargePeriodLow,
    "input_missing" => Self::InputMissing,
    "input_implausible" => Self::InputImplausible,
    "estimate_untrusted" => Self::EstimateUntrusted,
    "resistance_high" => Self::ResistanceHigh,
    "soc_low" => Self::SocLow,
    "temperature_high" => Self::TemperatureHigh,
    "cell_imbalance" => Self::CellImbalance,
    "remaining_life_low" => Self::RemainingLifeLow,
    "bms_disagrees" => Self::BmsDisagrees,
    "store_failed" => Self::StoreFailed,
    "bus_fault" => Self::BusFault,
});

section! {
    /// The pack: how many cells, how they are connected, and which cell they are.
    Pack at "pack" {
        /// Cells in series. Parallel cells that share one voltage tap count as one.
        cells: u16, "", Between(1.0, MAX_CELLS as f64), Required;
        /// Parallel strings; the pack current is taken to be shared by them equally.
        strings: u16, "", Between(1.0, 1024.0), Default("1");
        /// Cell model file, relative to this file.
        cell_model: String, "", NotEmpty, Required;
        /// Capacity on the label of one cell, which SOH is relative to. Without it: the cell model's.
        rated_capacity_ah: Option<f64>, "Ah", Above(0.0, 1e5), Optional;
        /// Capacity to start from when nothing was learned yet, per cell. Without it: the cell model's `capacity_ah`.
        initial_capacity_ah: Option<f64>, "Ah", Above(0.0, 1e5), Optional;
        /// Standard deviation of the capacity to start from. Without it: 10 % of that capacity.
        initial_capacity_std_ah: Option<f64>, "Ah", Above(0.0, 1e5), Optional;
        /// Temperature of the surroundings, used where no sensor says otherwise.
        ambient_c: f64, "degrees C", TEMPERATURE_C, Default("25.0");
    }
}

section! {
    /// A CAN interface, in the order in which the program counts them.
    Interface at "interface" {
        /// Kernel name, at most 15 characters.
        name: String, "", NotEmpty, Required;
        /// Whether CAN FD frames are accepted and may be sent.
        fd: bool, "", Any, Default("false");
    }
}

section! {
    /// What is read from the buses. One of `[input.cell_voltage]` and `[input.pack_voltage]` is needed, and `[input.current]`.
    Input at "input" {
        /// DBC files that describe the signals named below, relative to this file.
        dbc: Vec<String>, "", NotEmpty, Required;
        /// Frames of one identifier on one interface that are taken in; a tenth of it may come at once. What comes beyond is dropped, counted and told, so that a sender gone wild does not take the time of the others. The default is twice the fastest honest sender (one frame a millisecond) and half of what a saturated bus of 500 kbit/s carries.
        max_frames_per_s: u32, "frames/s", Between(10.0, 1e6), Default("2000");
    }
}

section! {
    /// An input message whose sender protects it end to end (AUTOSAR). The readings of a frame that fails its check (damaged, repeated, out of sequence, another message's, or the first after a start) are bad; each outcome is counted, and told when the message turns.
    ProtectedInput at "input.protected" {
        /// Name of the message in its DBC file; one of its signals must be an input.
        message: String, "", NotEmpty, Required;
        /// Interface the message comes on. Needed when there are several.
        interface: Option<String>, "", NotEmpty, Optional;
        /// AUTOSAR profile: 1 with the whole data identifier in the CRC (variant A), 1 with four bits of it sent (variant C), or 5.
        profile: Profile, "", Any, Required;
        /// Data identifier agreed with the sender; up to 0xFFF in 1C.
        data_id: u16, "", Between(0.0, 65535.0), Required;
        /// Frames that may be lost between two; each further check without a good frame allows one more. Up to 14 in profile 1.
        max_delta_counter: u16, "frames", Between(0.0, 255.0), Default("1");
        /// Repeated or missing frames in a row after which the sequence is to be shown anew (`sync_counter`); 14 = any number.
        max_repeated: u16, "frames", Between(0.0, 14.0), Default("14");
        /// Frames in sequence that show it after a jump too far; they are used. 0 = none is asked for: then profile 1 keeps to its old counter after a jump (of a sender that restarted) until the sender has come round to it, 14 frames at most.
        sync_counter: u16, "frames", Between(0.0, 14.0), Default("0");
    }
}

/// Declares a table that names a signal on a bus; every such table has these keys.
macro_rules! signal_section {
    ($(#[doc = $about:literal])+ $name:ident at $path:literal, $unit:literal { $($keys:tt)* }) => {
        section! {
            $(#[doc = $about])+
            $name at $path {
                /// `Message.Signal` of one of the DBC files; in `[input.cell_voltage]` a pattern, see there.
                signal: String, "", NotEmpty, Required;
                /// Interface the signal comes on. Needed when there are several.
                interface: Option<String>, "", NotEmpty, Optional;
                /// Factor from the DBC's unit to this program's, after the DBC's own factor (0.001 for a DBC in milli-units).
                scale: f64, $unit, Above(0.0, 1e9), Default("1.0");
                /// Added after `scale`, in this program's unit (-273.15 for a DBC in kelvin).
                offset: f64, "", Between(-1e9, 1e9), Default("0.0");
                /// Raw codes that mean "not available", besides those the DBC's value table calls so.
                not_available: Vec<u64>, "", Any, Default("[]");
                $($keys)*
            }
        }

        impl $name {
            /// What all signal tables have in common.
            pub fn source(&self) -> SignalSource<'_> {
                SignalSource {
                    place: &self.place,
                    signal: &self.signal,
                    interface: self.interface.as_deref(),
                    scale: self.scale,
                    offset: self.offset,
                    not_available: &self.not_available,
                }
            }
        }
    };
}

/// What every table that names a signal says.
#[derive(Debug, Clone, Copy)]
pub(super) struct SignalSource<'a> {
    /// Where it stands.
    pub place: &'a super::document::Place,
    /// `Message.Signal`, or a pattern.
    pub signal: &'a str,
    /// Interface name, when given.
    pub interface: Option<&'a str>,
    /// DBC unit to ours.
    pub scale: f64,
    /// Added after it.
    pub offset: f64,
    /// Raw codes that mean "not available".
    pub not_available: &'a [u64],
}

signal_section! {
    /// The pack current.
    CurrentInput at "input.current", "A per unit of the DBC" {
        /// What a positive value on the bus means. Buses differ, so there is no default; inside, and in everything this program reports, positive is discharge.
        positive: Positive, "", Any, Required;
    }
}

signal_section! {
    /// One voltage per cell. `{n}` in `signal` stands for the cell's number, `{m}` for any number, in message and signal name:
    /// `CellVoltages.Cell{n}`, `Module{m}.CellVoltage{n}`. Every cell must be found exactly once; multiplexed signals are welcome.
    CellVoltageInput at "input.cell_voltage", "V per unit of the DBC" {
        /// Number of the first cell in the names.
        first: u16, "", Between(0.0, 60000.0), Default("1");
    }
}

signal_section! {
    /// The pack's total voltage, for a pack that publishes no cell voltages: `pack.cells` equal cells are assumed and estimated as one.
    PackVoltageInput at "input.pack_voltage", "V per unit of the DBC" {}
}

signal_section! {
    /// A temperature sensor.
    TemperatureInput at "input.temperature", "degrees C per unit of the DBC" {
        /// Cells this sensor serves. Without it: all cells.
        cells: Option<CellRanges>, "", Any, Optional;
    }
}

signal_section! {
    /// State of charge as the pack itself reports it, for the rule `bms_disagrees`; no estimate is made of it. A DBC in % is taken as such where `scale` is not given.
    ReportedSocInput at "input.reported_soc", "fraction per unit of the DBC" {
        /// A reading older than this is stale.
        max_age_s: f64, "s", Above(0.0, 1e6), Default("10.0");
    }
}

signal_section! {
    /// State of health (capacity over rated capacity) as the pack itself reports it, likewise.
    ReportedSohInput at "input.reported_soh", "fraction per unit of the DBC" {
        /// A reading older than this is stale.
        max_age_s: f64, "s", Above(0.0, 1e6), Default("60.0");
    }
}

signal_section! {
    /// A number that tells packs apart, such as a serial number: another value than the known one means that another pack is connected, also when it was changed while the program did not run. What was learned of the old pack is told once more and does not hold for the new one, as with the command `pack-replaced`.
    PackIdentityInput at "input.pack_identity", "any unit" {
        /// Readings in a row that must show the same new value.
        readings: u32, "", Between(1.0, 10000.0), Default("10");
    }
}

section! {
    /// What a plausible pack current is. A reading outside moves no estimate and is counted.
    CurrentLimits at "limits.current" {
        /// Largest plausible discharge current of the pack. Without it: what the DBC gives (never more).
        max_discharge_a: Option<f64>, "A", Above(0.0, 1e6), Optional;
        /// Largest plausible charge current of the pack, written positive. Without it: what the DBC gives (never more).
        max_charge_a: Option<f64>, "A", Above(0.0, 1e6), Optional;
        /// Fastest plausible change. Without it: not checked.
        max_rate_a_per_s: Option<f64>, "A/s", Above(0.0, 1e9), Optional;
        /// A reading that has not moved at all for this long is stuck. Without it: not checked (a parked pack's current may well stand still).
        stuck_after_s: Option<f64>, "s", Above(0.0, 1e9), Optional;
        /// A reading older than this is stale: estimates go on without it, their deviation grows, and they say so.
        max_age_s: f64, "s", Above(0.0, 1e6), Default("1.0");
    }
}

section! {
    /// What a plausible cell voltage is; a total voltage is divided by `pack.cells` first.
    VoltageLimits at "limits.voltage" {
        /// Smallest plausible voltage of a cell. Without it: what the DBC gives, but at least half the cell model's `voltage_min_v`.
        min_v: Option<f64>, "V", Between(0.0, 1e3), Optional;
        /// Largest plausible voltage of a cell. Without it: what the DBC gives, but at most the cell model's `voltage_max_v` and 0.5 V.
        max_v: Option<f64>, "V", Above(0.0, 1e3), Optional;
        /// Fastest plausible change. Without it: not checked.
        max_rate_v_per_s: Option<f64>, "V/s", Above(0.0, 1e6), Optional;
        /// A reading that has not moved at all for this long, while the current has, is stuck. Without it: not checked.
        stuck_after_s: Option<f64>, "s", Above(0.0, 1e9), Optional;
        /// A reading older than this is stale.
        max_age_s: f64, "s", Above(0.0, 1e6), Default("2.0");
    }
}

section! {
    /// What a plausible temperature is.
    TemperatureLimits at "limits.temperature" {
        /// Lowest plausible temperature. Without it: what the DBC gives, but at least -60.
        min_c: Option<f64>, "degrees C", TEMPERATURE_C, Optional;
        /// Highest plausible temperature. Without it: what the DBC gives, but at most 150.
        max_c: Option<f64>, "degrees C", TEMPERATURE_C, Optional;
        /// Fastest plausible change. Without it: not checked.
        max_rate_c_per_s: Option<f64>, "degrees C/s", Above(0.0, 1e6), Optional;
        /// A reading that has not moved at all for this long, while the current has, is stuck. Without it: not checked.
        stuck_after_s: Option<f64>, "s", Above(0.0, 1e9), Optional;
        /// A reading older than this is stale; the thermal model, if the cell has one, takes over.
        max_age_s: f64, "s", Above(0.0, 1e6), Default("10.0");
    }
}

section! {
    /// The unscented Kalman filter of each cell. Noises are densities, per square root of a second, so that the sample rate does not change the result.
    Estimator at "estimator" {
        /// Spread of the sigma points.
        alpha: f64, "", Above(0.0, 1.0), Default("1.0");
        /// Prior knowledge of the distribution; 2 for a Gaussian one.
        beta: f64, "", Between(0.0, 10.0), Default("2.0");
        /// Secondary scaling of the sigma points.
        kappa: f64, "", Between(0.0, 10.0), Default("0.0");
        /// How the circuit is stepped: exactly, or by forward Euler as in the paper.
        discretisation: Discretisation, "", Any, Default("\"exact\"");
        /// Whether the filter carries the capacity as a state ("joint", with method "swing"), or holds the learned one as in the paper ("held", with method "nominal").
        capacity_state: CapacityState, "", Any, Default("\"joint\"");
        /// SOC to start from. Without it: from the first voltage through the open-circuit voltage curve.
        initial_soc: Option<f64>, "fraction", Between(0.0, 1.0), Optional;
        /// Standard deviation of the first SOC.
        initial_soc_std: f64, "fraction", Above(0.0, 1.0), Default("0.3");
        /// Standard deviation of the first branch voltages.
        initial_branch_std_v: f64, "V", Between(0.0, 10.0), Default("0.05");
        /// Standard deviation of the logarithm of the resistance relative to new, at the start.
        initial_log_resistance_std: f64, "", Between(0.0, 5.0), Default("0.2");
        /// Process noise of the SOC.
        soc_noise_per_sqrt_s: f64, "fraction/sqrt(s)", DEVIATION, Default("3e-5");
        /// Process noise of the SOC per charge moved: errors of the current reading.
        charge_noise_per_sqrt_soc: f64, "fraction/sqrt(SOC)", DEVIATION, Default("3e-3");
        /// Process noise of the branch voltages.
        branch_noise_v_per_sqrt_s: f64, "V/sqrt(s)", DEVIATION, Default("1e-3");
        /// Process noise of the logarithm of the resistance: how fast a cell may age, and how far its resistance may be from the tables in the cold or in the next minutes of a drive.
        log_resistance_noise_per_sqrt_s: f64, "1/sqrt(s)", DEVIATION, Default("1e-3");
        /// Process noise of the SOC while nobody measures the current (asleep).
        gap_noise_per_sqrt_s: f64, "fraction/sqrt(s)", DEVIATION, Default("1.5e-5");
        /// What a cell may lose by itself in a month: the deviation of the SOC grows with the time nobody measured (asleep, off).
        self_discharge_per_month: f64, "fraction", Between(0.0, 1.0), Default("0.03");
        /// What may be taken out or charged in an hour while the program does not run. Whether it was is judged by the first voltage after that time; until it has come, the deviation of the SOC is as large as this makes it. 0: the cells are certainly left alone.
        away_use_per_h: f64, "fraction", Between(0.0, 100.0), Default("0.5");
        /// A current up to this is rest; one beyond it beside a gap may have gone on in it. Without it: the rated capacity over 50 h (C/50), per cell.
        rest_current_a: Option<f64>, "A", Between(0.0, 1e6), Optional;
        /// Standard deviation of the voltage sensor's noise.
        voltage_noise_v: f64, "V", Above(0.0, 10.0), Default("0.005");
        /// Slow error of the cell model: standard deviation of its average over one second. More samples per second bring no more information than this. Where the cell model has a `voltage_error_v`, that holds instead.
        model_error_v_sqrt_s: f64, "V sqrt(s)", DEVIATION, Default("0.15");
        /// Slow error of the cell model, as part of the voltage lost in the cell at the reading: standard deviation of its average over one second.
        drop_error_sqrt_s: f64, "sqrt(s)", DEVIATION, Default("0.3");
        /// Slow error of the cell model under load, as part of the voltage the load drops in the cell: standard deviation of its average over one second.
        load_error_sqrt_s: f64, "sqrt(s)", DEVIATION, Default("0.5");
        /// How long that error outlives the load (slow diffusion).
        load_memory_s: f64, "s", Above(0.0, 1e6), Default("1200.0");
        /// Longest time one voltage reading may speak for: readings further apart are no better than this.
        max_information_s: f64, "s", Above(0.0, 1e6), Default("100.0");
        /// A voltage further from its prediction than this many standard deviations moves nothing.
        gate_sigma: f64, "", Above(0.0, 1e6), Default("5.0");
        /// Error of the cell model a single reading may show (standard deviation), for the gate and the consistency monitor.
        gate_model_error_v: f64, "V", Between(0.0, 10.0), Default("0.06");
        /// The same as an error along the open-circuit voltage curve.
        gate_soc_error: f64, "fraction", Between(0.0, 1.0), Default("0.02");
        /// When every reading has been beyond the gate for this long, the filter has lost its cell and starts again from the voltage.
        lost_after_s: f64, "s", Above(0.0, 1e9), Default("30.0");
        /// Window over which the filter's consistency is judged.
        consistency_window_s: f64, "s", Above(0.0, 1e9), Default("600.0");
        /// Mean normalised innovation squared above which an estimate is not to be trusted (1 = as expected).
        consistency_limit: f64, "", Above(0.0, 1e9), Default("4.0");
    }
}

section! {
    /// When the pack charges, rests or discharges.
    Transition at "transition" {
        /// Pack current up to which the pack rests. Without it: the rated capacity of all strings over 50 h (C/50).
        dead_band_a: Option<f64>, "A", Between(0.0, 1e6), Optional;
        /// The current must be this far beyond the dead band's edge for a mode to change. Without it: half the dead band.
        hysteresis_a: Option<f64>, "A", Between(0.0, 1e6), Optional;
        /// A new mode must hold this long before it counts.
        min_duration_s: f64, "s", Between(0.0, 1e6), Default("10.0");
        /// A charge or discharge that moves less than this part of the rated capacity is joined to what follows, until together they do. For method "nominal": most of its swing, so that a pause does not cut a half-cycle in two.
        min_swing: f64, "fraction", Between(0.0, 1.0), Default("0.02");
    }
}

section! {
    /// The capacity filter, which runs at each transition.
    Capacity at "capacity" {
        /// Charge over the SOC swing the voltages tell (variance from the swing's uncertainty), or over a nominal swing as in the paper.
        method: Method, "", Any, Default("\"swing\"");
        /// Swing assumed by method "nominal".
        nominal_swing: f64, "fraction", Above(0.0, 1.0), Default("0.6");
        /// Measurement variance of method "nominal".
        nominal_variance_ah2: f64, "Ah^2", Above(0.0, 1e9), Default("0.1");
        /// Standard deviation gained per equivalent full cycle ("swing") or per event ("nominal"). Without it: 0.5 % of the rated capacity ("swing"), 1 Ah ("nominal", as in the paper).
        noise_ah_per_cycle: Option<f64>, "Ah", DEVIATION, Optional;
        /// Standard deviation gained in a day of rest, after which some capacity comes back ("swing" only). Without it: 2 % of the rated capacity.
        noise_ah_per_rest_day: Option<f64>, "Ah", DEVIATION, Optional;
        /// Error of the cell model's open-circuit voltage at the ends of a half-cycle ("swing" only). It repeats, so it bounds what one half-cycle can tell.
        end_error_v: f64, "V", DEVIATION, Default("0.005");
        /// The same as part of the voltage the load drops in the cell ("swing" only).
        end_load_error: f64, "", DEVIATION, Default("0.075");
        /// Error of the cell model's `ocv_ageing_shift` ("swing" only): what the change of the curve's shape with lost capacity makes uncertain.
        ageing_shift_error: f64, "", DEVIATION, Default("0.3");
        /// Standard deviation of the current sensor's gain: no capacity is known better than this.
        current_gain_std: f64, "fraction", Between(0.0, 1.0), Default("0.005");
        /// Standard deviation of the current sensor's offset, per cell: what charges and discharges disagree by is learned and taken off the current ("swing" only; 0 = not learned). Where the model of the cell is good to a few mV.
        current_offset_std_a: f64, "A", DEVIATION, Default("0.0");
        /// Standard deviation of what a full cycle takes, at the start: the loss is learned and expected at the end of each charge ("swing" only; 0 = not learned). For cells that lose several percent in a cycle; in others, capacity that comes back in rest would be taken for it.
        fade_std_ah_per_cycle: f64, "Ah", DEVIATION, Default("0.0");
        /// How fast the fade may change: standard deviation gained per equivalent full cycle.
        fade_noise_ah_per_cycle: f64, "Ah", DEVIATION, Default("0.0");
        /// Part of the rated capacity at which a cell is at the end of its life: what remains until then is forecast.
        end_of_life: f64, "fraction", Above(0.0, 1.0), Default("0.8");
    }
}

section! {
    /// The SOC window whose charging time is the recharge period: raw, as the charge at hand took, and normalised, as a reference charger would take.
    Recharge at "recharge" {
        /// Lower SOC.
        from_soc: f64, "fraction", Between(0.0, 1.0), Default("0.3");
        /// Upper SOC.
        to_soc: f64, "fraction", Between(0.0, 1.0), Default("0.9");
        /// Current of the reference charger, per cell, which it holds over the whole window: the normalised period is the window's share of the learned capacity over it. Without it: the rated capacity over 2 h (C/2).
        reference_current_a: Option<f64>, "A", Above(0.0, 1e6), Optional;
        /// Part of the window that a charge must cover to be told with a normalised period (a raw one needs all of it).
        min_coverage: f64, "fraction", Above(0.0, 1.0), Default("0.5");
        /// What the alarm `recharge_period_low` compares. "raw": each period as soon as the charge leaves the window; a stronger charger looks like a worn pack, a weaker one hides it. "normalised": what the reference charger would need, at the end of each charge that covered enough.
        alarm_on: RechargeAlarm, "", Any, Default("\"raw\"");
    }
}

section! {
    /// The load at which usable capacity is stated; without this table it is not reported.
    Usable at "usable" {
        /// Discharge current, per cell.
        current_a: f64, "A", Above(0.0, 1e6), Required;
        /// Cell temperature.
        temperature_c: f64, "degrees C", TEMPERATURE_C, Required;
        /// Voltage under load at which the discharge ends.
        cutoff_v: f64, "V", Above(0.0, 100.0), Required;
        /// A charge whose current, per cell, has fallen to this at the cell model's highest voltage ended full: the SOC it left is where the next usable capacity starts. Without it: the rated capacity over 20 h (C/20).
        taper_current_a: Option<f64>, "A", Above(0.0, 1e6), Optional;
    }
}

section! {
    /// The alarms of a rule. What each rule compares, and the unit of its thresholds:
    /// `capacity_low`, `usable_capacity_low` Ah per cell; `recharge_period_low` s; `resistance_high` times that of a new cell;
    /// `soc_low` (the emptiest cell), `cell_imbalance` (SOC between the fullest and the emptiest cell), `bms_disagrees` (SOC or SOH as the pack reports it less ours), `input_implausible` (share of bad readings) fractions;
    /// `temperature_high` (the hottest sensor) degrees C; `remaining_life_low` equivalent full cycles;
    /// `input_missing` (silence), `store_failed` and `bus_fault` (for how long) s; `estimate_untrusted` the mean normalised innovation squared.
    Alarm at "alarm" {
        /// What it is about.
        rule: Rule, "", Any, Required;
        /// Threshold of the alarm of severity "info": raised when the value is below it (`*_low`) or above it (the others). A number in the rule's unit, or a text like "80 %": of the rated capacity, of the period the reference charger needs for it, of a new cell's resistance, of a fraction's 1. With `{ set = ..., clear = ... }` it is cleared at `clear`. At least one of `info`, `warning` and `severe` is needed, and each at most once per rule.
        info: Option<Threshold>, "the rule's", Between(-1e9, 1e9), Optional;
        /// The same for severity "warning". Without it: no such alarm.
        warning: Option<Threshold>, "the rule's", Between(-1e9, 1e9), Optional;
        /// The same for severity "severe". Without it: no such alarm.
        severe: Option<Threshold>, "the rule's", Between(-1e9, 1e9), Optional;
        /// Cleared when the value is back on the healthy side by this much, where the threshold does not say `clear`. Without it: 2 % of the threshold.
        hysteresis: Option<f64>, "the rule's", Between(0.0, 1e9), Optional;
        /// What is compared: "mean" the value itself; `{ probability = 0.95 }` raises when the probability that the truth is beyond the threshold passes that level (and clears when the probability that it is beyond the clear threshold is at most that level, and at most one half). A level above one half raises later and seldom wrongly, one below it earlier.
        when: Comparison, "", Any, Default("\"mean\"");
        /// Must hold this long before it is raised, and be healthy this long before it clears.
        debounce_s: f64, "s", Between(0.0, 1e9), Default("0.0");
        /// Must hold for this many new values before it is raised or cleared.
        debounce_events: u32, "", Between(1.0, 1e6), Default("1");
        /// Whether it stays raised when the value is healthy again, until somebody clears it.
        latched: bool, "", Any, Default("false");
        /// J1939: suspect parameter number. Without it: 520192 (maker-assignable) plus the rule's number.
        spn: Option<u32>, "", Between(1.0, 524_287.0), Optional;
        /// J1939: failure mode identifier. Without it: by rule and severity (17, 18, 1 for a value too low, 15, 16, 0 for one too high; 9 for a missing input, 2 for an implausible one and a pack that disagrees, 19 for a bus, 31 for an estimate not to be trusted and a store).
        fmi: Option<u16>, "", Between(0.0, 31.0), Optional;
    }
}

section! {
    /// State and history on disk (`run --state`). What is learned is stored when it is announced, whatever is set here.
    Store at "store" {
        /// Period of the checkpoints of the running state, which a power cut may lose (a restart of the service loses a second). Each writes 5 to 9 kB for a pack of 96 cells.
        checkpoint_s: f64, "s", Between(1.0, 3600.0), Default("60.0");
        /// Half-cycles kept, counting one per cell; beyond it every second transition of the older half is taken out, again and again. The default is a year of ten half-cycles a day and 50 cells and some 15 MB. Capacities, alarms and resets are kept for ever.
        max_half_cycles: u32, "", Between(1000.0, 1e8), Default("200000");
    }
}

/// Every table of the configuration, in the order of the reference page.
pub(super) const SECTIONS: &[SectionInfo] = &[
    SectionInfo::one::<Pack>(),
    SectionInfo::many::<Interface>(),
    SectionInfo::one::<Input>(),
    SectionInfo::one::<CurrentInput>(),
    SectionInfo::one::<CellVoltageInput>(),
    SectionInfo::one::<PackVoltageInput>(),
    SectionInfo::many::<TemperatureInput>(),
    SectionInfo::one::<ReportedSocInput>(),
    SectionInfo::one::<ReportedSohInput>(),
    SectionInfo::one::<PackIdentityInput>(),
    SectionInfo::many::<ProtectedInput>(),
    SectionInfo::one::<CurrentLimits>(),
    SectionInfo::one::<VoltageLimits>(),
    SectionInfo::one::<TemperatureLimits>(),
    SectionInfo::one::<Estimator>(),
    SectionInfo::one::<Transition>(),
    SectionInfo::one::<Capacity>(),
    SectionInfo::one::<Recharge>(),
    SectionInfo::one::<Usable>(),
    SectionInfo::many::<Alarm>(),
    SectionInfo::one::<J1939>(),
    SectionInfo::one::<Output>(),
    SectionInfo::one::<OutputStatus>(),
    SectionInfo::one::<OutputHealth>(),
    SectionInfo::one::<OutputAlarm>(),
    SectionInfo::one::<Commands>(),
    SectionInfo::one::<Store>(),
];
