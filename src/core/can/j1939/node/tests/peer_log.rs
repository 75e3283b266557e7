//! Checks the log of sent frames that `tests/vcan/j1939_peers.test` plays to other J1939 implementations.

use std::fmt::Write as _;

use super::*;

const LOG: &str = include_str!("../../../../../../tests/vcan/j1939_peers.log");

fn code(spn: u32, fmi: u8, count: u32, lamp: Lamp) -> ActiveCode {
    ActiveCode { code: TroubleCode::new(spn, fmi, count).unwrap(), lamp }
}

/// Sends the address claim. Then sends DM1 with 0, 1, 2, 5 and 27 codes, and DM1 without codes while not all values are
/// known. Last, sends DM2 with 0, 1 and 3 codes. Each step takes two seconds.
fn played() -> Bench {
    let mut bench = Bench::new();
    bench.set(&[]);
    bench.node.start(at(0), &mut bench.out);
    let five = [
        code(1, 0, 1, Lamp::Protect),
        code(91, 2, 126, Lamp::Amber),
        code(520_193, 18, 3, Lamp::Amber),
        code(131_072, 9, 200, Lamp::None),
        code(524_287, 31, 0, Lamp::Protect),
    ];
    let many: Vec<_> = (1..=27).map(|n| code(520_192 + n, 17, n, Lamp::Red)).collect();
    for (step, codes) in [&[], &five[2..3], &five[1..3], &five, &many[..]].into_iter().enumerate() {
        bench.run_to(2000 * i64::try_from(step).unwrap());
        bench.set(codes);
    }
    bench.run_to(10_000);
    bench.node.set_codes(at(10_000), &[], &[], false);
    for (ms, dm2) in [(12_000, 0), (14_000, 1), (16_000, 3)] {
        bench.run_to(ms);
        let previously: Vec<_> = five[..dm2].iter().map(|active| active.code).collect();
        bench.node.set_codes(at(ms), &[five[0]], &previously, true);
        bench.run_to(ms + 100);
        bench.receive(&request(PGN_DM2, ADDRESS));
    }
    bench.run_to(18_000);
    bench
}

#[test]
fn peer_log_matches_sent_frames() {
    let mut log = String::new();
    for (ms, frame) in played().frames {
        let data: String = frame.data().iter().map(|byte| format!("{byte:02X}")).collect();
        let _ = writeln!(log, "({}.{:03}000) vcan0 {}#{data}", 1_700_000_000 + ms / 1000, ms % 1000, frame.id());
    }
    assert!(log == LOG, "replace tests/vcan/j1939_peers.log with:\n{log}");
}
