//! Tests that valid settings change the layout, that invalid settings are rejected with their key, and that a layout
//! rebuilt from its own text does not change.

use super::*;
use crate::can::encode::{CommandPlan, OutputPlan};

const TEXT: &str = include_str!("../../../../../config/packwatch.dbc");

fn built_in(settings: &LayoutSettings) -> Result<Database, Vec<SettingFault>> {
    layout(LayoutBase::BuiltIn { rated_capacity_ah: 2.6 }, settings)
}

fn on(profile: Profile, data_id: u16) -> MessageSettings {
    MessageSettings { e2e: E2eSetting::On(Protection { profile, data_id }), ..Default::default() }
}

fn with_status(status: MessageSettings) -> LayoutSettings {
    LayoutSettings { status, ..Default::default() }
}

/// Uses the shipped DBC with a replaced text as the user's own DBC. Returns key and text of the only fault.
fn own_fault(from: &str, to: &str, status: MessageSettings) -> (&'static str, String) {
    assert!(TEXT.contains(from), "{from}");
    let own = Database::parse(&TEXT.replace(from, to)).unwrap();
    let faults = layout(LayoutBase::Own(&own), &with_status(status)).unwrap_err();
    assert_eq!((faults.len(), faults[0].message), (1, LayoutMessage::Status), "{faults:?}");
    (faults[0].key, faults[0].what.clone())
}

#[test]
fn default_layout_is_shipped_file_without_command() {
    let shipped = default_database().unwrap();
    let made = built_in(&LayoutSettings::default()).unwrap();
    let sent = |name: &str| !matches!(name, "PACKWATCH_Command" | "PACKWATCH_Reply" | "PACKWATCH_Freshness");
    assert!(made.messages.iter().eq(shipped.messages.iter().filter(|message| sent(&message.name))));
    let command = Some(MessageSettings::default());
    let made = built_in(&LayoutSettings { command, ..Default::default() }).unwrap();
    assert!(made.messages.iter().eq(shipped.messages.iter().filter(|message| message.name != "PACKWATCH_Freshness")));
}

#[test]
fn identifiers_formats_and_periods_follow_settings() {
    let fd = MessageSettings { fd: Some(true), brs: Some(true), ..Default::default() };
    let settings = LayoutSettings {
        status: MessageSettings { id: CanId::extended(5), period_ms: Some(20), ..Default::default() },
        health: fd,
        alarm: MessageSettings { id: CanId::standard(7), fd: Some(true), ..Default::default() },
        ..Default::default()
    };
    let plan = OutputPlan::new(&built_in(&settings).unwrap()).unwrap();
    assert_eq!(plan.ids(), [CanId::Extended(5), CanId::Standard(0x6B1), CanId::Standard(7), CanId::Standard(0x6B4)]);
    let times_ms: Vec<_> = plan.messages().map(|sent| sent.cycle_time_ms).collect();
    assert_eq!(times_ms, [Some(20), Some(1000), Some(1000), Some(1000)]);
    let (fd, fast) = (FrameFormat::Fd { brs: false }, FrameFormat::Fd { brs: true });
    let formats: Vec<_> = plan.messages().map(|sent| sent.format).collect();
    assert_eq!(formats, [FrameFormat::Classic, fast, fd, FrameFormat::Classic]);
}

#[test]
fn profile_5_moves_built_in_signals_by_one_byte() {
    let shipped = default_database().unwrap();
    let settings = |data_id| MessageSettings { fd: Some(true), ..on(Profile::P05, data_id) };
    let all = LayoutSettings {
        status: settings(1),
        health: settings(2),
        alarm: settings(3),
        command: Some(settings(4)),
        digest: settings(5),
        reply: settings(6),
        freshness: MessageSettings::default(),
    };
    let made = built_in(&all).unwrap();
    for (message, shipped) in made.messages.iter().zip(&shipped.messages) {
        assert_eq!((message.len_bytes, message.signals.len()), (12, shipped.signals.len() + 2));
        assert_eq!((&*message.signals[0].name, &*message.signals[1].name), ("E2eCrc", "E2eCounter"));
        for (moved, shipped) in message.signals[2..].iter().zip(&shipped.signals) {
            assert_eq!((&moved.name, moved.layout.start_bit), (&shipped.name, shipped.layout.start_bit + 8));
            let selector = |message: &Message, signal: &Signal| {
                signal.conditions.first().map(|condition| message.signals[condition.selector].name.clone())
            };
            let shipped_message = default_database().unwrap();
            let shipped_message = shipped_message.message(&message.name).unwrap();
            assert_eq!(selector(message, moved), selector(shipped_message, shipped));
        }
    }
    assert!(OutputPlan::new(&made).is_ok() && CommandPlan::new(&made).is_ok());
}

#[test]
fn profile_5_in_classic_frames_is_rejected_with_advice() {
    let faults = built_in(&with_status(on(Profile::P05, 1))).unwrap_err();
    assert_eq!(
        faults[0].to_string(),
        "PACKWATCH_Status: must have fd = true here and on the interface: the header of profile 5 makes the message 12 \
         bytes long; 1A and 1C fit classic frames"
    );
    for profile in [Profile::P01A, Profile::P01C] {
        let made = built_in(&with_status(on(profile, 1))).unwrap();
        assert_eq!(made.messages[0].len_bytes, 8);
    }
}

#[test]
fn header_signals_are_named() {
    let names = |profile| {
        let made = built_in(&with_status(on(profile, 0x123))).unwrap();
        let status = &made.messages[0];
        let header = status.signals.iter().take_while(|signal| signal.name.starts_with("E2e"));
        header
            .map(|signal| (signal.name.clone(), signal.layout.start_bit, signal.layout.length_bits))
            .collect::<Vec<_>>()
    };
    let (crc, counter) = (("E2eCrc".to_owned(), 0, 8), ("E2eCounter".to_owned(), 8, 4));
    assert_eq!(names(Profile::P01A), [crc.clone(), counter.clone()]);
    assert_eq!(names(Profile::P01C), [crc, counter, ("E2eDataIdNibble".to_owned(), 12, 4)]);
}

#[test]
fn layout_rebuilt_from_its_text_is_unchanged() {
    let fd = |settings| MessageSettings { fd: Some(true), ..settings };
    let settings = LayoutSettings {
        status: fd(on(Profile::P05, 1)),
        health: on(Profile::P01C, 2),
        alarm: MessageSettings { id: CanId::extended(9), period_ms: Some(50), ..on(Profile::P01A, 3) },
        command: Some(fd(on(Profile::P05, 4))),
        digest: on(Profile::P01C, 5),
        reply: on(Profile::P01A, 6),
        freshness: MessageSettings::default(),
    };
    let made = layout(LayoutBase::BuiltIn { rated_capacity_ah: 280.0 }, &settings).unwrap();
    let read = Database::parse(&made.to_dbc()).unwrap();
    assert_eq!(read, made);
    let as_it_is = LayoutSettings { command: Some(MessageSettings::default()), ..Default::default() };
    assert_eq!(layout(LayoutBase::Own(&read), &as_it_is).unwrap(), made);
    assert_eq!(layout(LayoutBase::Own(&read), &settings).unwrap(), made, "with the same settings again");
    let off = MessageSettings { e2e: E2eSetting::Off, ..Default::default() };
    let plain = layout(LayoutBase::Own(&read), &with_status(off)).unwrap();
    assert_eq!((plain.messages[0].e2e, &*plain.messages[0].signals[0].name), (None, "Soc"));
}

#[test]
fn own_dbc_must_leave_header_free() {
    let status = MessageSettings { fd: Some(true), ..on(Profile::P05, 1) };
    let (key, what) = own_fault("VERSION", "VERSION", status);
    let wanted = "signal PACKWATCH_Status.Soc begins at bit 16, must leave the 24 bits of the header of profile 5 free";
    assert_eq!((key, &*what), ("e2e", wanted));
    let (key, what) = own_fault("Soc : 16|12@1+", "Soc : 11|12@0+", on(Profile::P01C, 1));
    let wanted =
        "signal PACKWATCH_Status.Soc begins at bit 11, must leave the 16 bits of the header of profile 1C free";
    assert_eq!((key, &*what), ("e2e", wanted));
}

#[test]
fn profile_1a_leaves_upper_nibble_to_a_signal() {
    let own = Database::parse(&TEXT.replace("SocStd : 28|8@1+", "SocStd : 12|4@1+")).unwrap();
    assert!(layout(LayoutBase::Own(&own), &with_status(on(Profile::P01A, 1))).is_ok());
    assert!(layout(LayoutBase::Own(&own), &with_status(on(Profile::P01C, 1))).is_err());
    let own = Database::parse(&TEXT.replace("SocStd : 28|8@1+", "SocStd : 15|4@0+")).unwrap();
    assert!(
        layout(LayoutBase::Own(&own), &with_status(on(Profile::P01A, 1))).is_ok(),
        "the same bits in the other byte order"
    );
    let own = Database::parse(&TEXT.replace("SocStd : 28|8@1+", "SocStd : 15|5@0+")).unwrap();
    assert!(layout(LayoutBase::Own(&own), &with_status(on(Profile::P01A, 1))).is_err());
}

#[test]
fn invalid_frame_and_profile_lengths_are_rejected() {
    let length = |len: u32, status| own_fault("PACKWATCH_Status: 8", &format!("PACKWATCH_Status: {len}"), status);
    let what = "message PACKWATCH_Status has 10 bytes, must have a valid CAN FD length: padding is not protected";
    assert_eq!(length(10, on(Profile::P01A, 1)), ("e2e", what.to_owned()));
    let what = "message PACKWATCH_Status has 32 bytes, must have 2 to 30 for profile 1A";
    assert_eq!(length(32, on(Profile::P01A, 1)), ("e2e", what.to_owned()));
    let classic = MessageSettings { fd: Some(false), ..Default::default() };
    assert_eq!(length(12, classic), ("fd", "must be true: message PACKWATCH_Status has 12 bytes".to_owned()));
}

#[test]
fn long_message_of_own_dbc_uses_fd_frames() {
    let own = Database::parse(&TEXT.replace("PACKWATCH_Status: 8", "PACKWATCH_Status: 12")).unwrap();
    let made = layout(LayoutBase::Own(&own), &LayoutSettings::default()).unwrap();
    assert_eq!(made.messages[0].format, FrameFormat::Fd { brs: false });
    assert_eq!(made.messages[1].format, FrameFormat::Classic);
}

#[test]
fn missing_cycle_time_becomes_default_in_dbc() {
    let text = TEXT.replace("BA_ \"GenMsgCycleTime\" BO_ 1712 100;\n", "");
    let made = layout(LayoutBase::Own(&Database::parse(&text).unwrap()), &LayoutSettings::default()).unwrap();
    assert_eq!(made.messages[0].cycle_time_ms, Some(1000));
}

#[test]
fn all_invalid_settings_are_reported_with_keys() {
    let wrong = LayoutSettings {
        status: MessageSettings { brs: Some(true), ..Default::default() },
        health: on(Profile::P01C, 0x1000),
        ..Default::default()
    };
    let faults = built_in(&wrong).unwrap_err();
    assert_eq!(
        faults.iter().map(|fault| (fault.message, fault.key)).collect::<Vec<_>>(),
        [(LayoutMessage::Status, "brs"), (LayoutMessage::Health, "data_id")]
    );
}

#[test]
fn ah_steps_fit_rated_capacity() {
    let steps = |rated_capacity_ah| {
        let made = layout(LayoutBase::BuiltIn { rated_capacity_ah }, &LayoutSettings::default()).unwrap();
        let step = |name: &str| {
            let layout = made.signal(name).unwrap().1.layout;
            let share = if name.ends_with("Std") { 0.5 } else { 2.0 };
            assert!(layout.maximum >= share * rated_capacity_ah, "{name} for {rated_capacity_ah} Ah");
            let codes = layout.plan().unwrap().code(layout.maximum).unwrap();
            assert_eq!(
                codes,
                layout.plan().unwrap().all_ones() - 1,
                "{name}: all codes except the one for not available"
            );
            layout.factor
        };
        let [value, threshold] =
            ["Value_CapacityLow", "Threshold_UsableCapacityLow"].map(|name| step(&format!("PACKWATCH_Alarm.{name}")));
        assert_eq!(threshold, decimal(2.0 * value));
        [value, step("PACKWATCH_Health.Capacity"), step("PACKWATCH_Health.CapacityStd")]
    };
    assert_eq!(steps(2.6), [0.01, 0.01, 0.001]);
    assert_eq!(steps(40.94), [0.01, 0.01, 0.001]);
    assert_eq!(steps(40.95), [0.02, 0.01, 0.001]);
    assert_eq!(steps(280.0), [0.1, 0.01, 0.005]);
    assert_eq!(steps(1000.0), [0.5, 0.05, 0.01]);
    assert_eq!(steps(100_000.0), [50.0, 5.0, 1.0]);
}

#[test]
fn own_dbc_keeps_steps_but_not_foreign_messages() {
    let text = format!("{TEXT}\nBO_ 5 Other: 8 PACKWATCH\n SG_ X : 0|8@1+ (1,0) [0|0] \"Ah\" PACKWATCH\n");
    let own = Database::parse(&text).unwrap();
    let made = layout(LayoutBase::Own(&own), &LayoutSettings::default()).unwrap();
    let names: Vec<_> = made.messages.iter().map(|message| message.name.as_str()).collect();
    assert_eq!(names, ["PACKWATCH_Status", "PACKWATCH_Health", "PACKWATCH_Alarm", "PACKWATCH_Digest"]);
    assert!(made.messages.iter().all(|message| own.message(&message.name) == Some(message)));
    assert_eq!((&made.nodes, &made.comment), (&own.nodes, &own.comment));
}

#[test]
fn own_dbc_without_digest_and_reply_is_accepted() {
    let mut own = default_database().unwrap();
    own.messages.retain(|message| !matches!(message.name.as_str(), "PACKWATCH_Digest" | "PACKWATCH_Reply"));
    let settings = LayoutSettings { command: Some(MessageSettings::default()), ..Default::default() };
    let plan = OutputPlan::new(&layout(LayoutBase::Own(&own), &settings).unwrap()).unwrap();
    assert_eq!(plan.ids(), [0x6B0, 0x6B1, 0x6B2].map(CanId::Standard));
    assert_eq!((plan.digest_pages(), plan.has_reply()), (0, false));
}

fn secoc(profile: secoc::Profile, data_id: u16) -> MessageSettings {
    MessageSettings { secoc: Some(Authentication { profile, data_id }), ..Default::default() }
}

#[test]
fn authenticated_message_has_trailer_signals() {
    let fd = |settings| MessageSettings { fd: Some(true), ..settings };
    for (profile, len_bytes) in [(secoc::Profile::P1, 8), (secoc::Profile::P3, 8), (secoc::Profile::Fd, 16)] {
        let command = secoc(profile, 4);
        let settings = LayoutSettings {
            alarm: MessageSettings { e2e: on(Profile::P05, 3).e2e, ..fd(secoc(secoc::Profile::Fd, 3)) },
            digest: fd(secoc(secoc::Profile::Fd, 5)),
            command: Some(if profile == secoc::Profile::Fd { fd(command) } else { command }),
            freshness: secoc(secoc::Profile::Announcement, 6),
            ..Default::default()
        };
        let made = built_in(&settings).unwrap();
        assert_eq!(Database::parse(&made.to_dbc()).unwrap(), made, "{profile:?}");
        let lens = ["Alarm", "Digest", "Command", "Freshness"]
            .map(|name| made.message(&format!("PACKWATCH_{name}")).unwrap().len_bytes);
        assert_eq!(lens, [24, 20, len_bytes, 8], "{profile:?}");
        let plan = CommandPlan::new(&made).unwrap();
        assert_eq!((plan.authentication(), plan.protection()), (command.secoc, None));
        // The trailer must be written where the trailer signals are.
        let command = made.message("PACKWATCH_Command").unwrap();
        let mut payload = vec![0; usize::from(len_bytes)];
        let authentication = Authentication { profile, data_id: 4 };
        authentication.write_freshness(&mut payload, 0xFEDC_BA98_7654_3210);
        authentication.write_mac(&mut payload, [0xA5; 16]);
        let raw = |name| command.signal(name).unwrap().layout.plan().unwrap().raw(&payload).unwrap();
        assert_eq!(raw("SecOCFreshness"), 0xFEDC_BA98_7654_3210 & ((1 << profile.freshness_bits()) - 1));
        assert_eq!(raw("SecOCMac"), 0xA5A5_A5A5_A5A5_A5A5 >> (64 - profile.mac_bits()));
        assert_eq!(raw("Command") + raw("Rule") + raw("Severity") + raw("Cell"), 0, "{profile:?}");
    }
}

#[test]
fn trailer_that_does_not_fit_is_rejected() {
    let fault = |settings: &LayoutSettings| {
        let faults = built_in(settings).unwrap_err();
        assert_eq!(faults.len(), 1, "{faults:?}");
        format!("{}: {}", faults[0].key, faults[0].what)
    };
    let classic = LayoutSettings { alarm: secoc(secoc::Profile::Fd, 3), ..Default::default() };
    assert_eq!(
        fault(&classic),
        "secoc: must have fd = true here and on the interface: freshness and authenticator make the message 20 bytes long"
    );
    let own = Database::parse(TEXT).unwrap();
    let settings = LayoutSettings { command: Some(secoc(secoc::Profile::P1, 4)), ..Default::default() };
    let faults = layout(LayoutBase::Own(&own), &settings).unwrap_err();
    let texts: Vec<_> = faults.iter().map(|fault| (fault.key, fault.what.as_str())).collect();
    assert_eq!(
        texts,
        [("secoc", "signal PACKWATCH_Command.Cell must leave the last 4 bytes free for profile 1")],
        "the signals of an own DBC are not moved"
    );
}
