//! Tests `[[alarm]]` and `[commands]`: the resulting settings, and the full text of every fault.

use super::*;

#[test]
fn relative_threshold_uses_rated_capacity() {
    let alarm = "[[alarm]]\nrule = \"capacity_low\"\nwarning = \"75 %\"\n";
    assert_eq!(good(&format!("{PACK}{alarm}")).monitor.rules[0].threshold, 1.5);
    let rated = pack_with("cells = 4", "cells = 4\nrated_capacity_ah = 4");
    let config = good(&format!("{rated}{alarm}"));
    assert_eq!((config.monitor.rules[0].threshold, config.monitor.model.rated_capacity_ah), (3.0, 4.0));
}

#[test]
fn alarm_and_command_faults_are_reported() {
    let cases: &[(&str, &str)] = &[
        (
            "[[alarm]]\nrule = \"capacity_low\"\n",
            "pack.toml:15: alarm[1] has no threshold, must have info, warning or severe",
        ),
        (
            "[[alarm]]\nrule = \"usable_capacity_low\"\nwarning = 1\n",
            "pack.toml:16: alarm[1].rule = \"usable_capacity_low\", requires a table [usable], which states the load",
        ),
        (
            "[[alarm]]\nrule = \"input_missing\"\nwarning = \"80 %\"\n",
            "pack.toml:17: alarm[1].warning = \"80 %\", must be a number: percentages are not defined for this rule",
        ),
        (
            "[[alarm]]\nrule = \"input_missing\"\nwarning = 1\n[[alarm]]\nrule = \"input_missing\"\nwarning = 2\n",
            "pack.toml:20: alarm[2].warning = 2, must be given once per rule, but alarm[1] in line 15 also gives it",
        ),
        (
            "[[alarm]]\nrule = \"capacity_low\"\nwarning = { set = 1.5, clear = \"74 %\" }\n",
            "pack.toml:17: alarm[1].warning = { set = 1.5, clear = \"74 %\" }, must clear at 1.5 Ah or above, not at 74 % (1.48 Ah)",
        ),
        (
            "[[alarm]]\nrule = \"temperature_high\"\nsevere = { set = 60, clear = 61 }\n",
            "pack.toml:17: alarm[1].severe = { set = 60, clear = 61 }, must clear at 60 degrees C or below, not at 61 degrees C",
        ),
        (
            "[[alarm]]\nrule = \"capacity_low\"\nwarning = 1.4\nsevere = 1.5\n",
            "pack.toml:18: alarm[1].severe = 1.5, must be below warning = 1.4 Ah: it is the more severe threshold",
        ),
        (
            "[[alarm]]\nrule = \"soc_low\"\nwarning = 10\n",
            "pack.toml:17: alarm[1].warning = 10, must be 0 to 1, or a string like \"20 %\"",
        ),
        (
            "[[alarm]]\nrule = \"soc_low\"\nwarning = { set = 0.1, clera = 0.2 }\n",
            "pack.toml:17: alarm[1].warning = { set = 0.1, clera = 0.2 }, must be a number, a string like \"80 %\", or { set \
             = ..., clear = ... } of these (the rule's unit)",
        ),
        (
            "[[alarm]]\nrule = \"input_missing\"\nwarning = 1\nwhen = { probability = 0.9 }\n",
            "pack.toml:18: alarm[1].when = { probability = 0.9 }, must be \"mean\": the value of this rule has no standard \
             deviation",
        ),
        (
            "[[alarm]]\nrule = \"recharge_period_low\"\nwarning = 1\nwhen = { probability = 0.9 }\n",
            "pack.toml:18: alarm[1].when = { probability = 0.9 }, must be \"mean\" with recharge.alarm_on = \"raw\": the raw period has no standard deviation",
        ),
        (
            "[[alarm]]\nrule = \"capacity_low\"\nwarning = 1\nwhen = { probability = 1.5 }\n",
            "pack.toml:18: alarm[1].when = { probability = 1.5 }, must be \"mean\", or { probability = ... } above 0 and \
             below 1",
        ),
        (
            "[[alarm]]\nrule = \"bms_disagrees\"\nwarning = 0.1\n",
            "pack.toml:16: alarm[1].rule = \"bms_disagrees\", requires [input.reported_soc] or [input.reported_soh]",
        ),
        (
            "[commands]\nenabled = true\ne2e = \"1A\"\ndata_id = 1\n",
            "pack.toml:16: commands.enabled = true, requires an enabled table [output]: every command is answered with a reply frame",
        ),
        (
            "[output]\n[commands]\nenabled = true\n",
            "pack.toml:16: commands.e2e is not set, must be \"1A\", \"1C\" or \"5\" if secoc is not given: unprotected commands are not accepted",
        ),
        (
            "[output]\n[commands]\nenabled = true\ne2e = \"1A\"\ndata_id = 1\nid = 0x6B1\n",
            "pack.toml:20: commands.id = 0x6B1, must not be the identifier of a sent frame, 6B1",
        ),
        (
            "[output.alarm]\ne2e = \"1A\"\ndata_id = 1\n[commands]\nenabled = true\ne2e = \"1A\"\ndata_id = 1\n",
            "pack.toml:21: commands.data_id = 1, must differ from the data ids of the sent frames",
        ),
        (
            "[output]\n[commands]\nenabled = true\nsecoc = \"1\"\ndata_id = 1\n[output.freshness]\ndata_id = 2\n",
            "pack.toml:1: authentication.credential is not set, must be the name of a systemd credential, unless key_file names a file: secoc requires a key",
        ),
        (
            "[output]\n[commands]\nenabled = true\nsecoc = \"1\"\ndata_id = 1\n[authentication]\ncredential = \"k\"\n",
            "pack.toml:15: output.freshness.data_id is not set, must be 0 to 0xFFFF with commands.secoc",
        ),
        (
            "[output.digest]\nid = 0x6B2\n",
            "pack.toml:16: output.digest.id = 0x6B2, must differ: the digest and alarm frames would both have identifier 6B2",
        ),
        (
            "[output.reply]\nperiod_ms = 100\n",
            "pack.toml:16: output.reply.period_ms = 100, must not be given: a reply is sent only after a command",
        ),
        (
            "[output]\n[commands]\nenabled = true\ne2e = \"5\"\ndata_id = 1\n",
            "pack.toml:18: commands.e2e = \"5\", must have fd = true here and on the interface: the header of profile 5 \
             makes the message 12 bytes long; 1A and 1C fit classic frames",
        ),
        (
            "[output]\n[commands]\nenabled = true\ninterface = \"can1\"\ne2e = \"1A\"\ndata_id = 1\n",
            "pack.toml:18: commands.interface = \"can1\", must be can0",
        ),
        (
            "[[alarm]]\nrule = \"soc_low\"\nwarning = { set = 0.1, clear = 15 }\n",
            "pack.toml:17: alarm[1].warning = { set = 0.1, clear = 15 }, must clear warning at 0 to \
             1, not at 15",
        ),
        (
            "[[alarm]]\nrule = \"soc_low\"\nwarning = 0.97\nhysteresis = 0.05\n",
            "pack.toml:18: alarm[1].hysteresis = 0.05, must clear warning at 0 to 1, not at 1.02",
        ),
        (
            "[[alarm]]\nrule = \"bus_fault\"\nwarning = 1\nhysteresis = 0.5\n",
            "pack.toml:18: alarm[1].hysteresis = 0.5, must not be given: the alarm clears when the fault has ended",
        ),
    ];
    for (table, fault) in cases {
        assert_eq!(faults(&format!("{PACK}{table}")), [*fault]);
    }
}

#[test]
fn sent_frame_rejects_weak_profiles() {
    let table = "[output.alarm]\nsecoc = \"1\"\ndata_id = 1\n[authentication]\ncredential = \"k\"\n";
    let expected = "pack.toml:16: output.alarm.secoc = \"1\", must be \"fd\" for a frame that is sent";
    assert_eq!(faults(&format!("{PACK}{table}"))[0], expected);
}
