//! Tests end-to-end protection with published vectors and with arbitrary payloads.

#![allow(clippy::unwrap_used, reason = "tests may panic")]

use proptest::prelude::*;

use super::*;

const PROFILES: [Profile; 3] = [Profile::P01A, Profile::P01C, Profile::P05];

fn protected(profile: Profile, data_id: u16, payload: &[u8], counter: u8) -> Vec<u8> {
    let mut payload = payload.to_vec();
    Protection { profile, data_id }.protect(&mut payload, counter).unwrap();
    payload
}

#[test]
fn crcs_match_published_check_values() {
    assert_eq!(crc8(0, b"123456789"), 0x37);
    assert_eq!(crc16(0xFFFF, b"123456789"), 0x29B1);
    // AUTOSAR's CRC-8 SAE J1850 starts from 0xFF and inverts its result.
    assert_eq!(crc8(0xFF, b"123456789") ^ 0xFF, 0x4B);
}

#[test]
fn profile_1a_matches_test_vectors() {
    assert_eq!(protected(Profile::P01A, 0x0123, &[0; 8], 0), [0xCC, 0, 0, 0, 0, 0, 0, 0]);
    assert_eq!(protected(Profile::P01A, 0x0123, &[0; 8], 1), [0x91, 1, 0, 0, 0, 0, 0, 0]);
    let upper_nibble_kept = protected(Profile::P01A, 0x0123, &[0xFF, 0xF5, 0, 0, 0, 0, 0, 0], 0);
    assert_eq!(upper_nibble_kept, [0x65, 0xF0, 0, 0, 0, 0, 0, 0]);
}

#[test]
fn profile_1c_matches_test_vectors() {
    assert_eq!(protected(Profile::P01C, 0x0123, &[0; 8], 0), [0x2A, 0x10, 0, 0, 0, 0, 0, 0]);
    assert_eq!(protected(Profile::P01C, 0x0123, &[0xFF, 0xFF, 0, 0, 0, 0, 0, 0], 1), [0x77, 0x11, 0, 0, 0, 0, 0, 0]);
}

#[test]
fn profile_5_matches_test_vector() {
    assert_eq!(protected(Profile::P05, 0x1234, &[0; 8], 0), [0x1C, 0xCA, 0, 0, 0, 0, 0, 0]);
}

#[test]
fn counter_wraps_at_limit_of_profile() {
    for (profile, last) in [(Profile::P01A, 14), (Profile::P01C, 14), (Profile::P05, 255)] {
        assert_eq!((profile.next_counter(0), profile.next_counter(last - 1), profile.next_counter(last)), (1, last, 0));
        assert_eq!(profile.counter_delta(last, 0), 1);
        assert_eq!(profile.counter_delta(5, 4), last);
    }
    assert_eq!(Profile::P01A.next_counter(15), 0, "an invalid counter is followed by a valid one");
}

#[test]
fn unprotectable_payload_is_error_and_unchanged() {
    for profile in PROFILES {
        let protection = Protection { profile, data_id: 1 };
        let needed = profile.header_bytes();
        for found in 0..needed {
            let mut short = vec![0xAA; found];
            assert_eq!(
                protection.protect(&mut short, 0).unwrap_err().to_string(),
                format!("payload of {found} bytes, must be at least {needed} bytes for this profile")
            );
            assert_eq!(short, vec![0xAA; found]);
            assert_eq!(protection.verified_counter(&short), None);
        }
        assert_eq!(
            protection.protect(&mut vec![0; needed], 0),
            Ok(()),
            "a payload with only the header can be protected"
        );
    }
    let mut payload = [0xAA; 8];
    let protection = Protection { profile: Profile::P01A, data_id: 1 };
    assert_eq!(protection.protect(&mut payload, 15).unwrap_err().to_string(), "end-to-end counter 15, must be 0 to 14");
    assert_eq!(payload, [0xAA; 8]);
}

#[test]
fn profile_1_counter_15_is_rejected_despite_valid_crc() {
    let protection = Protection { profile: Profile::P01A, data_id: 0x0123 };
    let mut payload = [0; 8];
    payload[1] = 15;
    payload[0] = protection.crc8(&payload);
    assert_eq!((protection.counter(&payload), protection.verified_counter(&payload)), (Some(15), None));
}

#[test]
fn profile_1c_compares_identifier_nibble() {
    let (sender, receiver) = (0x0123, Protection { profile: Profile::P01C, data_id: 0x0223 });
    assert_eq!(receiver.verified_counter(&protected(Profile::P01C, sender, &[0; 8], 3)), None, "the CRCs are equal");
}

#[test]
fn profiles_serialise_with_configuration_names() {
    for profile in PROFILES {
        assert_eq!(serde_json::to_string(&profile).unwrap(), format!("\"{}\"", profile.name()));
    }
}

#[test]
fn header_mask_covers_bytes_written_by_protect() {
    for profile in PROFILES {
        let mut written = [0_u8; 64];
        for (counter, data_id) in
            (0..=profile.max_counter()).flat_map(|counter| (0..32).map(move |n| (counter, n * 2111)))
        {
            for fill in [0x00, 0xFF] {
                let before = [fill; 64];
                let after = protected(profile, data_id, &before, counter);
                written.iter_mut().zip(before.iter().zip(&after)).for_each(|(w, (b, a))| *w |= b ^ a);
            }
        }
        assert_eq!(written[..3], profile.header_mask());
        assert!(written[3..].iter().all(|byte| *byte == 0));
        assert_eq!(profile.header_bytes(), profile.header_mask().iter().filter(|byte| **byte != 0).count());
    }
}

/// Flips every combination of `wrong_bits` bits. Returns how many combinations pass the check, and how many were tried.
fn undetected(protection: Protection, payload: &[u8], counter: u8, wrong_bits: usize) -> (usize, usize) {
    let mut payload = payload.to_vec();
    protection.protect(&mut payload, counter).unwrap();
    let (mut missed, mut tried, mut chosen) = (0, 0, (0..wrong_bits).collect::<Vec<_>>());
    loop {
        let flip = |payload: &mut Vec<u8>| chosen.iter().for_each(|bit| payload[bit / 8] ^= 1 << (bit % 8));
        flip(&mut payload);
        missed += usize::from(protection.verified_counter(&payload).is_some());
        tried += 1;
        flip(&mut payload);
        // Next combination in ascending order: move up the last bit that can move, and place all higher bits directly
        // after it.
        let last = 8 * payload.len() - wrong_bits;
        let Some(place) = (0..wrong_bits).rfind(|place| chosen[*place] < last + place) else { break };
        let first = chosen[place] + 1;
        chosen.splice(place.., first..first + wrong_bits - place);
    }
    (missed, tried)
}

/// Checks the figures in the section "What a profile finds" of the manual's page `ecu/protection.md`.
#[test]
fn undetected_bit_errors_match_manual() {
    const ZEROS: [u8; 12] = [0; 12];
    const MIXED: [u8; 12] = [0x13, 0xF7, 0xA5, 0x00, 0xFF, 0x3C, 0x81, 0x5E, 0x22, 0x9B, 0xE0, 0x47];
    let most_missed = |profile: Profile, length: usize, counters: &[u8], wrong_bits: usize| {
        let of = |(payload, data_id): (&[u8], u16), counter: u8| {
            undetected(Protection { profile, data_id }, &payload[..length], counter, wrong_bits)
        };
        let messages: [(&[u8], u16); 2] = [(&ZEROS, 0), (&MIXED, 0x0A53)];
        messages.iter().flat_map(|message| counters.iter().map(move |counter| of(*message, *counter))).max().unwrap()
    };
    let all_counters: Vec<u8> = (0..=14).collect();
    for (profile, three_bits) in [(Profile::P01A, 198), (Profile::P01C, 169)] {
        assert_eq!(most_missed(profile, 8, &all_counters, 1), (0, 64), "{profile:?}");
        assert_eq!(most_missed(profile, 8, &all_counters, 2), (0, 2016), "{profile:?}");
        assert_eq!(most_missed(profile, 8, &all_counters, 3), (three_bits, 41_664), "{profile:?}");
    }
    for (length, choices) in [(8, [64, 2016, 41_664]), (12, [96, 4560, 142_880])] {
        for (wrong_bits, tried) in (1..).zip(choices) {
            assert_eq!(most_missed(Profile::P05, length, &[0, 1, 127, 255], wrong_bits), (0, tried), "{length} bytes");
        }
    }
    let manual = include_str!("../../../../docs/src/ecu/protection.md");
    let row = "| three wrong bits | all but 198 (1A) or 169 (1C) of 41,664 possible errors (0.5 %, 0.4 %) | all |";
    assert!(manual.lines().any(|line| line == row), "the manual must contain the row\n{row}");
}

fn any_protection() -> impl Strategy<Value = Protection> {
    (prop::sample::select(PROFILES.to_vec()), any::<u16>())
        .prop_map(|(profile, data_id)| Protection { profile, data_id })
}

proptest! {
    #[test]
    fn protected_payload_verifies_unless_bit_flips(
        protection in any_protection(),
        mut payload in prop::collection::vec(any::<u8>(), 3..=30),
        counter: u8,
        bit: prop::sample::Index,
    ) {
        let counter = counter % protection.profile.max_counter();
        protection.protect(&mut payload, counter).unwrap();
        prop_assert_eq!(protection.verified_counter(&payload), Some(counter));
        let bit = bit.index(payload.len() * 8);
        payload[bit / 8] ^= 1 << (bit % 8);
        prop_assert_eq!(protection.verified_counter(&payload), None);
    }

    #[test]
    fn payload_of_other_message_is_rejected(
        data_id: u16, bit in 0_u32..16, mut payload in prop::collection::vec(any::<u8>(), 3..=30),
    ) {
        for profile in PROFILES {
            if profile == Profile::P01C && bit >= 12 {
                continue; // 1C does not use these bits of the identifier
            }
            Protection { profile, data_id }.protect(&mut payload, 0).unwrap();
            let other = Protection { profile, data_id: data_id ^ 1 << bit };
            prop_assert_eq!(other.verified_counter(&payload), None);
        }
    }

    #[test]
    fn arbitrary_bytes_get_status(
        protection in any_protection(),
        payloads in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..=64), 0..40),
    ) {
        let (config, mut receiver) = (CheckConfig::new(protection), Receiver::default());
        for payload in &payloads {
            receiver.check(&config, payload);
        }
        prop_assert_eq!(receiver.counts().total(), payloads.len() as u64);
    }
}
