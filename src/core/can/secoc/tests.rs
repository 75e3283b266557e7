//! Tests the layout of the trailer and the acceptance of freshness values.

#![allow(clippy::unwrap_used, reason = "tests may panic")]

use proptest::prelude::*;

use super::*;
use crate::quantity::Timestamp;

const COMMAND: Authentication = Authentication { profile: Profile::P1, data_id: 0x0124 };

/// Replaces AES-128-CMAC, because these tests only need different results for different inputs.
fn mac(input: &[u8]) -> Mac {
    let mut state: u128 = 0x6C62_272E_07BB_0142_62B8_2175_6295_C58D;
    for byte in input {
        state = (state ^ u128::from(*byte)).wrapping_mul(0x0000_0000_0100_0000_0000_0000_0000_013B);
    }
    // The first bits must depend on the last byte.
    for _ in 0..2 {
        state = (state ^ state >> 67).wrapping_mul(0x9E37_79B9_7F4A_7C15_F39C_C060_5CED_C835);
    }
    state.to_be_bytes()
}

fn sealed(authentication: Authentication, data: &[u8], freshness: u64) -> Vec<u8> {
    let mut payload = [data, &vec![0; authentication.profile.trailer_bytes()]].concat();
    authentication.write_freshness(&mut payload, freshness);
    let input = authentication.mac_input(&payload, freshness).unwrap();
    authentication.write_mac(&mut payload, mac(input.bytes()));
    payload
}

#[test]
fn trailer_is_freshness_then_authenticator_msb_first() {
    let whole = [0xA1, 0xB2, 0xC3, 0xD4, 0xE5, 0xF6, 0x07, 0x18, 0x29, 0x3A, 0x4B, 0x5C, 0x6D, 0x7E, 0x8F, 0x90];
    let written = |profile| {
        let authentication = Authentication { profile, data_id: 1 };
        let mut payload = vec![0x11; 1 + profile.trailer_bytes()];
        authentication.write_freshness(&mut payload, 0x0123_4567_89AB_CDEF);
        authentication.write_mac(&mut payload, whole);
        payload
    };
    assert_eq!(written(Profile::P1), [0x11, 0xEF, 0xA1, 0xB2, 0xC3]);
    assert_eq!(written(Profile::P3), [0x11, 0xFA, 0x1B, 0x2C, 0x3D]);
    assert_eq!(written(Profile::Fd), [0x11, 0x89, 0xAB, 0xCD, 0xEF, 0xA1, 0xB2, 0xC3, 0xD4, 0xE5, 0xF6, 0x07, 0x18]);
    assert_eq!(written(Profile::Announcement), [0x11, 0x78, 0x9A, 0xBC, 0xDE, 0xFA, 0x1B, 0x2C, 0x3D]);
}

#[test]
fn authenticator_covers_data_id_data_and_freshness() {
    let input = COMMAND.mac_input(&[1, 2, 3, 4, 0xEE, 0xEE, 0xEE, 0xEE], 0x0102_0304_0506_0708).unwrap();
    assert_eq!(input.bytes(), [0x01, 0x24, 1, 2, 3, 4, 1, 2, 3, 4, 5, 6, 7, 8]);
    assert_eq!(COMMAND.mac_input(&[0; 3], 0), None, "shorter than the trailer");
    assert_eq!(COMMAND.mac_input(&[0; 69], 0), None, "more data than a frame can carry");
    assert_eq!(COMMAND.mac_input(&[0; 68], 0).unwrap().bytes().len(), 2 + 64 + 8, "the longest input");
}

#[test]
fn profiles_serialise_with_configuration_names() {
    for profile in Profile::ALL {
        assert_eq!(serde_json::to_string(&profile).unwrap(), format!("\"{}\"", profile.name()));
    }
}

#[test]
fn freshness_is_accepted_once_and_in_rising_order() {
    let mut window = FreshnessWindow::default();
    window.begin(Timestamp::from_secs(1000.0));
    let announced = window.announce();
    let fits = |window: &FreshnessWindow, value| window.check(COMMAND, &sealed(COMMAND, &[1; 4], value)).has(value);
    assert!(fits(&window, announced) && fits(&window, announced + 15), "announced");
    assert!(fits(&window, announced - 16), "announced previously");
    assert!(!fits(&window, announced - 17) && !fits(&window, announced + 16), "too old, not yet announced");
    window.accept(announced + 5);
    for value in announced - 16..announced + 6 {
        assert!(!fits(&window, value), "{value}");
    }
    assert!(fits(&window, announced + 6));
    window.announce();
    assert!(fits(&window, announced + 6), "still covered by the previous announcement");
    window.announce();
    assert!(!fits(&window, announced + 15), "after two announcements, the value is too old");
    let last = window.announce();
    window.expire();
    assert!(!fits(&window, last + 15), "after time without listening, no earlier value is accepted");
}

#[test]
fn restart_begins_beyond_all_announced_values() {
    for (stored_s, now_s) in [(0.0, 1.7e9), (1.7e9, 1.7e9 + 100.0), (1.7e9, 0.0)] {
        let mut run = FreshnessWindow::default();
        run.begin(Timestamp::from_secs(stored_s));
        let stored = run;
        let mut last = 0;
        for _ in 0..3600 {
            last = run.announce();
        }
        let mut next = stored;
        next.begin(Timestamp::from_secs(now_s));
        let is_old = |value: u64| {
            next.check(COMMAND, &sealed(COMMAND, &[1; 4], value)).verify(&sealed(COMMAND, &[1; 4], value), mac)
        };
        assert!((last - 64..last + 16).all(|value| is_old(value).is_none()), "{stored_s} {now_s}");
    }
}

#[test]
fn start_begins_at_clock_unless_stored_value_is_higher() {
    let by_clock = 1_700_000_000 * ANNOUNCEMENT_STEP;
    let mut window = FreshnessWindow::default();
    window.begin(Timestamp::from_secs(1.7e9));
    assert_eq!(window.announced(), by_clock);
    window.begin(Timestamp::from_secs(1.6e9));
    assert_eq!(window.announced(), by_clock + 4096 * ANNOUNCEMENT_STEP, "the clock was set back");
}

#[test]
fn sent_bits_wrap_but_value_does_not() {
    for profile in [Profile::P1, Profile::P3, Profile::Fd] {
        let authentication = Authentication { profile, data_id: 7 };
        let mut window = FreshnessWindow { announced: (1 << 32) - 40 * ANNOUNCEMENT_STEP, accepted: 0 };
        for _ in 0..80 {
            let announced = window.announce();
            for value in [announced, announced + 3, announced + 15] {
                let payload = sealed(authentication, &[9; 4], value);
                assert_eq!(window.check(authentication, &payload).verify(&payload, mac), Some(value), "{profile:?}");
                window.accept(value);
                assert_eq!(window.check(authentication, &payload).verify(&payload, mac), None, "{profile:?}, repeated");
            }
        }
    }
}

#[test]
fn impossible_stored_window_is_detected() {
    assert!(FreshnessWindow::default().is_possible());
    assert!(FreshnessWindow { announced: 1600, accepted: 1615 }.is_possible());
    for (announced, accepted) in [(1601, 0), (1600, 1616), (u64::MAX - 15, 0)] {
        assert!(!FreshnessWindow { announced, accepted }.is_possible(), "{announced} {accepted}");
    }
}

proptest! {
    #[test]
    fn payload_with_one_wrong_bit_is_never_verified(
        profile in prop::sample::select(vec![Profile::P1, Profile::P3, Profile::Fd]),
        data in prop::collection::vec(any::<u8>(), 0..=20),
        step in 0_u64..1 << 40, offset in 0_u64..32, bit: prop::sample::Index,
    ) {
        let authentication = Authentication { profile, data_id: 0x321 };
        let mut window = FreshnessWindow { announced: step * ANNOUNCEMENT_STEP, accepted: 0 };
        let value = window.announce() - ANNOUNCEMENT_STEP + offset;
        let mut payload = sealed(authentication, &data, value);
        prop_assert_eq!(window.check(authentication, &payload).verify(&payload, mac), Some(value));
        let bit = bit.index(payload.len() * 8);
        payload[bit / 8] ^= 1 << (bit % 8);
        prop_assert_eq!(window.check(authentication, &payload).verify(&payload, mac), None);
    }

    #[test]
    fn arbitrary_bytes_never_panic(payload in prop::collection::vec(any::<u8>(), 0..=64), announced: u32) {
        for profile in Profile::ALL {
            let window = FreshnessWindow { announced: u64::from(announced) * ANNOUNCEMENT_STEP, accepted: 0 };
            let authentication = Authentication { profile, data_id: 1 };
            let found = window.check(authentication, &payload).verify(&payload, mac);
            prop_assert!(found.is_none_or(|value| window.check(authentication, &payload).has(value)));
        }
    }
}
