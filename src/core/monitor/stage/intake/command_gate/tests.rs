//! Tests which commands are executed: in normal operation, during an attack, and after a gap or a change of the clock.

use super::*;
use crate::can::secoc::Profile;

const COMMAND: Authentication = Authentication { profile: Profile::P1, data_id: 0x0124 };
const SECOND_NS: i64 = 1_000_000_000;
const RESET: [u8; 4] = [1, 0, 0, 0];
const CLEAR: [u8; 4] = [2, 0, 0, 0];

/// A gate, and a sender of commands. The gate announces freshness values (counters that are valid once), and the sender
/// uses them in rising order.
struct Bench {
    gate: CommandGate,
    now: Timestamp,
    /// The freshness of the next frame.
    next: u64,
}

impl Bench {
    /// A gate that starts and announces its freshness at 1000 s.
    fn new() -> Self {
        let mut gate = CommandGate::default();
        let now = Timestamp::from_secs(1000.0);
        gate.begin(now);
        let next = gate.announce(now);
        Self { gate, now, next }
    }

    fn wait(&mut self, nanos: i64) {
        self.now = self.now.plus_nanos(nanos);
    }

    /// Advances the time, and then announces a freshness.
    fn pass(&mut self, nanos: i64) {
        self.wait(nanos);
        self.next = self.gate.announce(self.now);
    }

    fn judge(&mut self, data: [u8; 4], freshness: u64, verified: Option<u64>) -> Result<(), CommandRefusal> {
        let mut payload = [data, [0; 4]].concat();
        COMMAND.write_freshness(&mut payload, freshness);
        self.gate.judge(self.now, COMMAND, &payload, verified)
    }

    /// Sends a command with a right authenticator.
    fn send(&mut self, data: [u8; 4]) -> Result<(), CommandRefusal> {
        self.next += 1;
        self.judge(data, self.next - 1, Some(self.next - 1))
    }

    /// Sends frames with a wrong authenticator.
    fn forge(&mut self, frames: u64) {
        for _ in 0..frames {
            assert_eq!(self.judge(RESET, self.next, None), Err(CommandRefusal::NotAuthentic));
        }
    }

    fn under_attack() -> Self {
        let mut bench = Self::new();
        bench.forge(10);
        bench
    }
}

#[test]
fn authentic_command_is_executed_once() {
    let mut bench = Bench::new();
    assert_eq!(bench.send(RESET), Ok(()));
    let used = bench.next - 1;
    assert_eq!(bench.judge(RESET, used, Some(used)), Err(CommandRefusal::OldFreshness));
    assert_eq!(bench.send(RESET), Ok(()), "the next freshness");
    assert_eq!(bench.gate.counts, CommandCounts { authentic: 2, old: 1, ..CommandCounts::default() });
}

#[test]
fn verified_freshness_must_fit_the_payload() {
    let mut bench = Bench::new();
    let (sent, other) = (bench.next, bench.next + 1);
    assert_eq!(bench.judge(RESET, sent, Some(other)), Err(CommandRefusal::NotAuthentic));
    assert_eq!(bench.judge(RESET, sent, Some(sent)), Ok(()), "the refused frame has used no freshness");
    assert_eq!(bench.gate.counts, CommandCounts { authentic: 1, forged: 1, ..CommandCounts::default() });
}

#[test]
fn payload_shorter_than_trailer_is_refused() {
    let mut bench = Bench::new();
    let verdict = bench.gate.judge(bench.now, COMMAND, &[0; 3], Some(bench.next));
    assert_eq!(verdict, Err(CommandRefusal::OldFreshness));
}

#[test]
fn announcement_is_outdated_after_two_seconds() {
    for (nanos, verdict) in [(2 * SECOND_NS, Ok(())), (2 * SECOND_NS + 1, Err(CommandRefusal::OldFreshness))] {
        let mut bench = Bench::new();
        bench.wait(nanos);
        assert_eq!(bench.send(RESET), verdict, "{nanos} ns after the announcement");
    }
}

#[test]
fn start_counts_as_announcement_for_staleness() {
    let mut bench = Bench::new();
    bench.wait(3600 * SECOND_NS);
    bench.gate.begin(bench.now);
    bench.next = bench.gate.window.announced();
    assert_eq!(bench.send(RESET), Ok(()));
}

#[test]
fn tenth_wrong_authenticator_starts_attack() {
    let mut bench = Bench::new();
    bench.forge(9);
    assert_eq!(bench.send(RESET), Ok(()), "nine are tolerated");
    bench.forge(1);
    assert_eq!(bench.send(RESET), Err(CommandRefusal::RepeatNeeded));
    assert_eq!(bench.send(RESET), Ok(()), "the repetition");
    assert_eq!(bench.send(RESET), Err(CommandRefusal::RepeatNeeded), "each command needs its own repetition");
    let counts = CommandCounts { authentic: 2, forged: 10, old: 0, unconfirmed: 2 };
    assert_eq!(bench.gate.counts, counts);
}

#[test]
fn attack_ends_ten_seconds_after_its_start() {
    for (nanos, verdict) in [(10 * SECOND_NS - 1, Err(CommandRefusal::RepeatNeeded)), (10 * SECOND_NS, Ok(()))] {
        let mut bench = Bench::under_attack();
        bench.forge(100);
        bench.pass(nanos);
        assert_eq!(bench.send(RESET), verdict, "{nanos} ns after the start; further forged frames do not prolong it");
    }
}

#[test]
fn forged_frame_after_attack_starts_next_attack() {
    let mut bench = Bench::under_attack();
    bench.pass(10 * SECOND_NS);
    bench.forge(1);
    assert_eq!(bench.send(RESET), Err(CommandRefusal::RepeatNeeded));
    bench.pass(10 * SECOND_NS);
    assert_eq!(bench.send(RESET), Ok(()));
}

#[test]
fn quiet_period_tolerates_one_more_forged_frame() {
    // Two periods pass: the attack, and a period without a wrong authenticator.
    let mut bench = Bench::under_attack();
    bench.pass(20 * SECOND_NS);
    bench.forge(1);
    assert_eq!(bench.send(RESET), Ok(()));
    bench.forge(1);
    assert_eq!(bench.send(RESET), Err(CommandRefusal::RepeatNeeded));
    // A long pause restores the whole tolerance, but not more.
    bench.pass(24 * 3600 * SECOND_NS);
    bench.forge(9);
    assert_eq!(bench.send(RESET), Ok(()));
    bench.forge(1);
    assert_eq!(bench.send(RESET), Err(CommandRefusal::RepeatNeeded));
}

#[test]
fn repetition_must_come_within_one_second() {
    for (nanos, verdict) in [(SECOND_NS, Ok(())), (SECOND_NS + 1, Err(CommandRefusal::RepeatNeeded))] {
        let mut bench = Bench::under_attack();
        assert_eq!(bench.send(RESET), Err(CommandRefusal::RepeatNeeded));
        bench.wait(nanos);
        assert_eq!(bench.send(RESET), verdict, "{nanos} ns after the command");
    }
}

#[test]
fn repetition_must_have_same_data() {
    let mut bench = Bench::under_attack();
    assert_eq!(bench.send(RESET), Err(CommandRefusal::RepeatNeeded));
    assert_eq!(bench.send(CLEAR), Err(CommandRefusal::RepeatNeeded), "another command");
    assert_eq!(bench.send(RESET), Err(CommandRefusal::RepeatNeeded), "the other command has replaced the first");
    assert_eq!(bench.send(RESET), Ok(()));
}

#[test]
fn gap_expires_freshness_and_repetition() {
    let mut bench = Bench::under_attack();
    assert_eq!(bench.send(RESET), Err(CommandRefusal::RepeatNeeded));
    bench.gate.restart(bench.now);
    assert_eq!(bench.send(RESET), Err(CommandRefusal::OldFreshness), "announced before the gap");
    bench.pass(0);
    assert_eq!(bench.send(RESET), Err(CommandRefusal::RepeatNeeded), "the command before the gap does not count");
    assert_eq!(bench.send(RESET), Ok(()));
}

#[test]
fn attack_lasts_ten_seconds_at_most_after_clock_steps_back() {
    for (nanos, verdict) in [(10 * SECOND_NS - 1, Err(CommandRefusal::RepeatNeeded)), (10 * SECOND_NS, Ok(()))] {
        let mut bench = Bench::under_attack();
        bench.wait(-500 * SECOND_NS);
        bench.gate.restart(bench.now);
        bench.pass(nanos);
        assert_eq!(bench.send(RESET), verdict, "{nanos} ns after the step");
    }
}

#[test]
fn rebase_keeps_time_left() {
    const SHIFT_NS: i64 = -700 * SECOND_NS;
    let rebased = |mut bench: Bench| {
        bench.gate.rebase(SHIFT_NS);
        bench.wait(SHIFT_NS);
        bench
    };
    let mut stale = rebased(Bench::new());
    stale.wait(2 * SECOND_NS + 1);
    assert_eq!(stale.send(RESET), Err(CommandRefusal::OldFreshness));
    let mut attacked = Bench::under_attack();
    assert_eq!(attacked.send(RESET), Err(CommandRefusal::RepeatNeeded));
    let mut attacked = rebased(attacked);
    attacked.wait(SECOND_NS);
    assert_eq!(attacked.send(RESET), Ok(()), "the repetition is still in time");
    assert_eq!(attacked.send(RESET), Err(CommandRefusal::RepeatNeeded));
    attacked.wait(SECOND_NS + 1);
    assert_eq!(attacked.send(RESET), Err(CommandRefusal::OldFreshness), "the announcement is outdated");
    attacked.pass(0);
    assert_eq!(attacked.send(RESET), Err(CommandRefusal::RepeatNeeded), "the repetition was too late");
    attacked.pass(8 * SECOND_NS);
    assert_eq!(attacked.send(RESET), Ok(()), "the attack has ended");
}

#[test]
fn counts_since_earlier_counts_are_differences() {
    let before = CommandCounts { authentic: 1, forged: 2, old: 3, unconfirmed: 4 };
    let after = CommandCounts { authentic: 11, forged: 22, old: 33, unconfirmed: 44 };
    assert_eq!(after.since(&before), CommandCounts { authentic: 10, forged: 20, old: 30, unconfirmed: 40 });
    assert_eq!(before.since(&after), CommandCounts::default(), "counts that were reset");
}

#[test]
fn impossible_stored_freshness_is_rejected() {
    let mut gate = Bench::new().gate;
    assert_eq!(gate.check_state(), Ok(()));
    gate.window.accept(gate.window.announced() + 16);
    assert!(gate.check_state().is_err());
}
