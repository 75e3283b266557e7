//! A clock that never steps: wall time at the program's start plus the CLOCK_BOOTTIME that has passed since then
//! (which includes suspend).
//!
//! The kernel stamps received frames with CLOCK_REALTIME, or with the adapter's own clock. CLOCK_REALTIME may step
//! (NTP, a clock set by hand). The origin of the adapter's clock is arbitrary. [`StampMapper`] converts both kinds of
//! stamps to the program's clock:
//!
//! * A software stamp becomes `stamp - (realtime - boottime)`. The difference `realtime - boottime` is measured when
//!   the frame is read. If CLOCK_REALTIME has just stepped, the difference from before the step gives a second
//!   candidate. If both candidates are plausible, the later one is used. If neither is plausible, the time of reading
//!   replaces the stamp.
//! * A time is plausible if it is not after the reading of the frame, and not before the socket was last found empty
//!   (with a small tolerance). The length of this interval bounds the error of any stamp.
//! * A hardware stamp becomes `stamp + offset`. The offset is the smallest recent value of `arrival - stamp`, because
//!   queueing can only increase this value. Old values are forgotten, so that the offset follows the drift of the
//!   adapter's quartz.
//!
//! Times of one interface never go backwards. All functions except the clock readings are pure, so that tests can
//! pass their own clock.

use std::time::Duration;

use nix::sys::time::TimeSpec;
use nix::time::{ClockId, clock_gettime};

use crate::quantity::Timestamp;

/// Length of a window (ns). The smallest offset of a hardware stamp is kept for one to two windows. In one window, a
/// quartz with an error of 100 ppm drifts by 1 ms.
const HARDWARE_WINDOW_NS: i64 = 10_000_000_000;

/// Maximum number of attempts to read the clocks for one [`Reading`].
const MOST_READINGS: usize = 4;

/// Both kernel clocks at one moment, ns since their origins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Reading {
    /// CLOCK_REALTIME.
    pub realtime_ns: i64,
    /// CLOCK_BOOTTIME.
    pub boottime_ns: i64,
}

impl Reading {
    /// Reads both clocks. Every kernel since 2.6.39 has CLOCK_BOOTTIME; on older kernels the reading is zero.
    pub fn now() -> Self {
        Self::between(nanos_of)
    }

    /// Reads the wall clock between two readings of the boot clock. Of several attempts, keeps the one in which these
    /// two readings are closest. On a busy processor, the thread may wait for milliseconds between two calls, which
    /// would falsify the difference of the clocks.
    fn between(clock: impl Fn(ClockId) -> i64) -> Self {
        let read = || {
            let before_ns = clock(ClockId::CLOCK_BOOTTIME);
            let realtime_ns = clock(ClockId::CLOCK_REALTIME);
            let apart_ns = clock(ClockId::CLOCK_BOOTTIME) - before_ns;
            (apart_ns, Self { realtime_ns, boottime_ns: before_ns + apart_ns / 2 })
        };
        let mut closest = read();
        for _ in 1..MOST_READINGS {
            // Two system calls on a slow processor take this long (ns), so a further attempt would not be better.
            if closest.0 <= 20_000 {
                break;
            }
            let again = read();
            if again.0 < closest.0 {
                closest = again;
            }
        }
        closest.1
    }

    fn offset_ns(self) -> i64 {
        self.realtime_ns - self.boottime_ns
    }
}

fn nanos_of(clock: ClockId) -> i64 {
    clock_gettime(clock).map_or(0, nanos)
}

/// Nanoseconds of a kernel time, which is never negative. The seconds have 32 or 64 bits, depending on the machine.
pub(super) fn nanos(time: TimeSpec) -> i64 {
    i64::try_from(Duration::from(time).as_nanos()).unwrap_or(i64::MAX)
}

/// Stamps that the kernel gave a frame, ns on their own clocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct KernelStamps {
    /// Stamp on CLOCK_REALTIME.
    pub software_ns: Option<i64>,
    /// Stamp on the adapter's clock.
    pub hardware_ns: Option<i64>,
}

/// The program's clock.
#[derive(Debug, Clone, Copy)]
pub struct MappedClock {
    /// Wall time minus boot time at the program's start, ns.
    origin_ns: i64,
}

impl MappedClock {
    /// The clock of a program that starts at `start`.
    pub fn new(start: Reading) -> Self {
        Self { origin_ns: start.offset_ns() }
    }

    /// The time at `reading`.
    pub fn at(&self, reading: Reading) -> Timestamp {
        Timestamp::from_nanos(self.origin_ns + reading.boottime_ns)
    }

    /// The time now.
    pub fn now(&self) -> Timestamp {
        Timestamp::from_nanos(self.origin_ns + nanos_of(ClockId::CLOCK_BOOTTIME))
    }
}

/// Smallest change of the wall clock that counts as a step, ns. NTP daemons correct smaller errors gradually, by less
/// than 1 ms a second.
const MIN_STEP_NS: i64 = 100_000_000;

/// Detects steps of the wall clock.
#[derive(Debug, Clone, Copy)]
pub struct StepDetector {
    /// Wall time minus boot time at the latest reading, ns.
    offset_ns: i64,
}

impl StepDetector {
    /// A detector that compares the next reading with `reading`.
    pub fn new(reading: Reading) -> Self {
        Self { offset_ns: reading.offset_ns() }
    }

    /// The step of the wall clock since the last reading (s); `None` = no step. Call it at least once a minute.
    pub fn step_s(&mut self, reading: Reading) -> Option<f64> {
        let step_ns = reading.offset_ns() - std::mem::replace(&mut self.offset_ns, reading.offset_ns());
        (step_ns.abs() >= MIN_STEP_NS).then_some(step_ns as f64 / 1e9)
    }
}

/// Maps the stamps of one interface.
#[derive(Debug, Clone)]
pub struct StampMapper {
    clock: MappedClock,
    /// Earliest boot time at which an unread frame can have arrived, ns.
    emptied_ns: i64,
    /// Wall time minus boot time when the socket was last found empty, ns.
    emptied_offset_ns: i64,
    hardware: HardwareClock,
    latest: Timestamp,
}

impl StampMapper {
    /// Creates a mapper for a socket opened at `reading`. No frame can have arrived earlier.
    pub fn new(clock: MappedClock, reading: Reading) -> Self {
        Self {
            clock,
            emptied_ns: reading.boottime_ns,
            emptied_offset_ns: reading.offset_ns(),
            hardware: HardwareClock::default(),
            latest: Timestamp::from_nanos(i64::MIN),
        }
    }

    /// Records that the socket was found empty at `reading`: frames that are read later arrived after `reading`.
    pub fn socket_empty(&mut self, reading: Reading) {
        self.emptied_ns = reading.boottime_ns;
        self.emptied_offset_ns = reading.offset_ns();
    }

    /// Records that one call returned the latest frame at `reading` and emptied the socket. Frames that are read later
    /// arrived after that frame.
    pub fn socket_emptied(&mut self, reading: Reading) {
        self.emptied_ns = self.latest.nanos().saturating_sub(self.clock.origin_ns);
        self.emptied_offset_ns = reading.offset_ns();
    }

    /// Arrival time of a frame read at `reading`; never before an earlier result.
    pub fn arrival(&mut self, stamps: KernelStamps, reading: Reading) -> Timestamp {
        let software = self.software(stamps.software_ns, reading);
        let arrived_ns = match stamps.hardware_ns {
            None => software,
            Some(stamp) => {
                let mapped = self.hardware.map(stamp, software);
                if self.possible(mapped, reading) { mapped } else { self.hardware.restart(stamp, software) }
            }
        };
        self.never_back(Timestamp::from_nanos(self.clock.origin_ns + arrived_ns))
    }

    /// Time of an interface event noticed at `reading`; never before an earlier result.
    pub fn event(&mut self, reading: Reading) -> Timestamp {
        self.never_back(self.clock.at(reading))
    }

    fn never_back(&mut self, time: Timestamp) -> Timestamp {
        self.latest = self.latest.max(time);
        self.latest
    }

    /// Converts a realtime stamp to the boot clock.
    fn software(&self, stamp: Option<i64>, reading: Reading) -> i64 {
        let candidates =
            [reading.offset_ns(), self.emptied_offset_ns].map(|offset| stamp.map(|s| s.saturating_sub(offset)));
        // The candidates differ only around a step. If both are plausible, use the later one, because frames are read
        // soon after they arrive.
        candidates.into_iter().flatten().filter(|&t| self.possible(t, reading)).max().unwrap_or(reading.boottime_ns)
    }

    fn possible(&self, arrived_ns: i64, reading: Reading) -> bool {
        // Tolerance: a frame may be stamped up to 20 ms before it is queued, because of soft interrupts and the
        // batching of USB adapters.
        (self.emptied_ns - 20_000_000..=reading.boottime_ns).contains(&arrived_ns)
    }
}

/// Keeps the smallest value of arrival minus stamp for one to two windows of [`HARDWARE_WINDOW_NS`].
#[derive(Debug, Clone, Default)]
struct HardwareClock {
    /// Smallest value of arrival minus stamp in this window and in the previous window, ns; `None` before the first
    /// stamp.
    least_ns: Option<(i64, i64)>,
    window_start_ns: i64,
}

impl HardwareClock {
    /// Converts an adapter's stamp to the boot clock; `arrived_ns` is the arrival according to the software stamp.
    fn map(&mut self, stamp_ns: i64, arrived_ns: i64) -> i64 {
        if arrived_ns.saturating_sub(self.window_start_ns) > 2 * HARDWARE_WINDOW_NS {
            // After a long silence the old offsets are useless, because the quartz has drifted.
            return self.restart(stamp_ns, arrived_ns);
        }
        let offset = arrived_ns.saturating_sub(stamp_ns);
        let (mut current, mut previous) = self.least_ns.unwrap_or((offset, offset));
        if arrived_ns - self.window_start_ns > HARDWARE_WINDOW_NS {
            self.window_start_ns = arrived_ns;
            (previous, current) = (current, offset);
        }
        current = current.min(offset);
        self.least_ns = Some((current, previous));
        stamp_ns.saturating_add(current.min(previous))
    }

    /// Starts again after a long silence, or after a jump of the adapter's clock (the adapter was reset or suspended).
    fn restart(&mut self, stamp_ns: i64, arrived_ns: i64) -> i64 {
        let offset = arrived_ns.saturating_sub(stamp_ns);
        *self = Self { least_ns: Some((offset, offset)), window_start_ns: arrived_ns };
        arrived_ns
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;

    const S: i64 = 1_000_000_000;
    const MS: i64 = 1_000_000;
    /// Wall time minus boot time in these tests.
    const OFFSET: i64 = 1_700_000_000 * S;

    fn at(boottime_ns: i64, step_ns: i64) -> Reading {
        Reading { realtime_ns: OFFSET + boottime_ns + step_ns, boottime_ns }
    }

    fn mapper() -> StampMapper {
        StampMapper::new(MappedClock::new(at(0, 0)), at(0, 0))
    }

    /// A frame arrives every 100 ms and is read 2 ms later; the wall clock steps by `step_ns` at `step_at_ns`.
    fn arrivals(step_ns: i64, step_at_ns: i64, by_the_same_call: bool) -> Vec<i64> {
        let mut mapper = mapper();
        let wall_step = |t: i64| if t >= step_at_ns { step_ns } else { 0 };
        (1..40)
            .map(|k| {
                let (arrived, read) = (k * 100 * MS, k * 100 * MS + 2 * MS);
                let stamps =
                    KernelStamps { software_ns: Some(OFFSET + arrived + wall_step(arrived)), hardware_ns: None };
                let time = mapper.arrival(stamps, at(read, wall_step(read)));
                // The socket is found empty by the same call or by the next call.
                if by_the_same_call {
                    mapper.socket_emptied(at(read, wall_step(read)));
                } else {
                    mapper.socket_empty(at(read, wall_step(read)));
                }
                time.nanos() - OFFSET
            })
            .collect()
    }

    /// Returns the reading of a thread that waits `waits_ns[n]` before its n-th call. Each call takes 1 us.
    fn reading_with_waits(waits_ns: &[i64]) -> Reading {
        let (calls, now_ns) = (Cell::new(0), Cell::new(0));
        Reading::between(|clock| {
            now_ns.set(now_ns.get() + waits_ns.get(calls.replace(calls.get() + 1)).unwrap_or(&0) + 1000);
            now_ns.get() + if clock == ClockId::CLOCK_REALTIME { OFFSET } else { 0 }
        })
    }

    #[test]
    fn step_is_detected_once_and_slew_is_not() {
        let mut detector = StepDetector::new(at(0, 0));
        assert_eq!(detector.step_s(at(S, 0)), None);
        assert_eq!(detector.step_s(at(2 * S, -3600 * S)), Some(-3600.0));
        assert_eq!(detector.step_s(at(3 * S, -3600 * S)), None);
        for second in 0..1000 {
            assert_eq!(detector.step_s(at((4 + second) * S, second * MS - 3600 * S)), None);
        }
    }

    #[test]
    fn thread_delay_between_clocks_distorts_no_stamp() {
        let busy = [4 * MS, 3 * MS, 0, 0, 0, 2 * MS, 0, 0, 0];
        for reading in [reading_with_waits(&[]), reading_with_waits(&busy), reading_with_waits(&[0, MS])] {
            assert_eq!(reading.offset_ns(), OFFSET, "{reading:?}");
        }
        // If the processor is always busy, the attempt with the closest readings is used.
        let reading = reading_with_waits(&[0, MS, MS, 0, 9 * MS, MS, 0, MS, 0, 0, 9 * MS, MS]);
        assert!((reading.offset_ns() - OFFSET).abs() <= MS / 2, "{reading:?}");
    }

    #[test]
    fn software_stamp_gives_arrival_not_reading() {
        assert_eq!(arrivals(0, 0, true)[0], 100 * MS);
    }

    #[test]
    fn wall_clock_step_keeps_time_differences() {
        // The clock steps between two frames, or between stamp and reading of one frame.
        for step_at in [1950 * MS, 2001 * MS] {
            for step in [3600 * S, -3600 * S, S / 2, -S / 2, 50 * MS, -50 * MS] {
                for times in [true, false].map(|by_the_same_call| arrivals(step, step_at, by_the_same_call)) {
                    for pair in times.windows(2) {
                        assert_eq!(pair[1] - pair[0], 100 * MS, "step {step} ns at {step_at} ns");
                    }
                }
            }
        }
    }

    #[test]
    fn frames_delayed_in_kernel_keep_distance() {
        let mut mapper = mapper();
        mapper.socket_empty(at(S, 0));
        let read = at(31 * S, 0);
        let times: Vec<i64> = (2..30)
            .map(|k| KernelStamps { software_ns: Some(OFFSET + k * S), hardware_ns: None })
            .map(|stamps| mapper.arrival(stamps, read).nanos() - OFFSET)
            .collect();
        assert_eq!(times, (2..30).map(|k| k * S).collect::<Vec<_>>());
    }

    #[test]
    fn implausible_stamp_becomes_time_of_reading() {
        let mut mapper = mapper();
        mapper.socket_empty(at(10 * S, 0));
        for wrong in [OFFSET + 12 * S, OFFSET + 9 * S, 0, i64::MIN, i64::MAX] {
            let stamps = KernelStamps { software_ns: Some(wrong), hardware_ns: None };
            assert_eq!(mapper.arrival(stamps, at(11 * S, 0)).nanos(), OFFSET + 11 * S);
        }
    }

    #[test]
    fn interface_times_never_go_backwards() {
        let mut mapper = mapper();
        let late = mapper.event(at(5 * S, 0));
        let stamps = KernelStamps { software_ns: Some(OFFSET + 4 * S), hardware_ns: None };
        assert_eq!(mapper.arrival(stamps, at(6 * S, 0)), late);
    }

    #[test]
    fn suspend_counts_as_time() {
        let clock = MappedClock::new(at(0, 0));
        assert_eq!(clock.at(at(8 * 3600 * S, 0)).since(clock.at(at(0, 0))), 28_800.0);
    }

    #[test]
    fn hardware_stamps_remove_jitter_and_follow_drift() {
        let mut mapper = mapper();
        // The adapter's clock started at 7 s of the program's clock and runs 100 ppm fast. Software stamps are up to 3
        // ms late.
        for k in 1..600_i64 {
            let arrived = 10 * S + k * 100 * MS;
            let late = (k * 7 % 4) * MS;
            let hardware = (arrived - 7 * S) + (arrived - 7 * S) / 10_000;
            let stamps = KernelStamps { software_ns: Some(OFFSET + arrived + late), hardware_ns: Some(hardware) };
            let read = at(arrived + late + MS, 0);
            let error = mapper.arrival(stamps, read).nanos() - OFFSET - arrived;
            mapper.socket_empty(at(arrived + late + MS, 0));
            assert!(k < 5 || (-MS / 10..=3 * MS).contains(&error), "frame {k}: {error} ns");
        }
    }

    #[test]
    fn silence_of_hours_discards_old_offsets() {
        let mut clock = HardwareClock::default();
        // The adapter's quartz is 50 ppm slow, which gives 1.44 s in eight silent hours.
        let stamp = |t: i64| t - t / 20_000;
        clock.map(stamp(S), S);
        for arrived in (0..200).map(|k| 8 * 3600 * S + k * 100 * MS) {
            let mapped = clock.map(stamp(arrived), arrived);
            assert!((mapped - arrived).abs() <= 2 * MS, "{} ns", mapped - arrived);
        }
    }

    #[test]
    fn restarted_adapter_clock_is_followed() {
        let mut mapper = mapper();
        for (k, hardware) in [(1, 500 * S), (2, 501 * S), (3, 0), (4, S), (5, 2 * S)] {
            let stamps = KernelStamps { software_ns: Some(OFFSET + k * S), hardware_ns: Some(hardware) };
            assert_eq!(mapper.arrival(stamps, at(k * S, 0)).nanos() - OFFSET, k * S);
            mapper.socket_empty(at(k * S, 0));
        }
    }
}
