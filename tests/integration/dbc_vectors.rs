//! Compares packwatch's decoding with `cantools`, an independent decoder. `PACKWATCH_PYTHON` names the Python
//! interpreter.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::ffi::OsString;
use std::path::Path;

use crate::support::measured;
use crate::support::oracle::{ask, hex, python, values};
use packwatch::alarm::Rule;
use packwatch::can::dbc::{Database, Message, MuxCondition};
use packwatch::can::encode::default_database;
use packwatch::quantity::Fault;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

/// Payloads per page of a message. A page is one selection of the multiplexors; a message without multiplexors has one
/// page.
const PAYLOADS: usize = 1000;

fn is_present(message: &Message, signal: usize, payload: &[u8]) -> bool {
    message.signals[signal].conditions.iter().all(|condition| {
        let code = message.signals[condition.selector].layout.plan().unwrap().raw(payload).unwrap();
        condition.ranges.iter().any(|(low, high)| (*low..=*high).contains(&code))
    })
}

/// Random payloads: `PAYLOADS` for each page of the message, with the page's multiplexor values written. The remaining
/// multiplexors also get values that some signal uses, because cantools rejects a payload with any other value.
fn payloads(message: &Message, random: &mut ChaCha8Rng) -> Vec<Vec<u8>> {
    let all: Vec<&MuxCondition> = message.signals.iter().flat_map(|signal| &signal.conditions).collect();
    let mut pages: Vec<&[MuxCondition]> = Vec::new();
    for signal in message.signals.iter().filter(|signal| !signal.conditions.is_empty()) {
        if !pages.contains(&signal.conditions.as_slice()) {
            pages.push(&signal.conditions);
        }
    }
    if pages.is_empty() {
        pages.push(&[]);
    }
    let mut made = Vec::new();
    for page in pages {
        for _ in 0..PAYLOADS {
            let mut payload = vec![0; usize::from(message.len_bytes)];
            random.fill_bytes(&mut payload);
            let mut pick = |among: usize| usize::try_from(random.next_u32()).unwrap() % among;
            let mut write = |condition: &MuxCondition, pick: &mut dyn FnMut(usize) -> usize| {
                let (low, high) = condition.ranges[pick(condition.ranges.len())];
                let span = usize::try_from(high - low).unwrap() + 1;
                let code = low + u64::try_from(pick(span)).unwrap();
                message.signals[condition.selector].layout.plan().unwrap().encode_raw(&mut payload, code).unwrap();
            };
            let selectors: BTreeSet<usize> = all.iter().map(|condition| condition.selector).collect();
            for selector in selectors {
                let asked: Vec<_> = all.iter().filter(|condition| condition.selector == selector).collect();
                write(asked[pick(asked.len())], &mut pick);
            }
            page.iter().for_each(|condition| write(condition, &mut pick));
            made.push(payload);
        }
    }
    made
}

#[derive(Debug, Default)]
struct Tally {
    payloads: usize,
    values: usize,
    /// Number of compared values per signal, by full name.
    per_signal: BTreeMap<String, usize>,
    /// For each signal that extends past the end of its message: number of payloads. All payloads are too short for
    /// such a signal.
    short: BTreeMap<String, usize>,
}

/// Compares every signal of every message in every payload, and whether the payload contains the signal.
fn compare(python: &OsString, path: &Path, strict: bool) -> Tally {
    let db = Database::parse_bytes(&std::fs::read(path).unwrap()).unwrap();
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let made = db
        .messages
        .iter()
        .flat_map(|message| payloads(message, &mut random).into_iter().map(move |payload| (message, payload)));
    let made: Vec<_> = made.collect();
    let lines: Vec<_> = made.iter().map(|(message, payload)| format!("{} {}", message.name, hex(payload))).collect();
    let arguments: &[&str] = if strict { &["decode", "strict"] } else { &["decode"] };
    let answers = ask(python, path, arguments, &lines);
    assert_eq!(answers.len(), lines.len());
    let mut tally = Tally { payloads: made.len(), ..Default::default() };
    for (((message, payload), line), answer) in made.iter().zip(&lines).zip(&answers) {
        compare_payload(message, payload, &mut values(line, answer), &mut tally);
    }
    let signals: usize = db.messages.iter().map(|message| message.signals.len()).sum();
    let counted = ask(python, path, &["count"], &[]);
    assert_eq!(counted, [format!("{} {signals}", db.messages.len())], "messages and signals");
    assert_eq!(tally.per_signal.len() + tally.short.len(), signals, "a signal was never present");
    for (name, count) in tally.per_signal.iter().chain(&tally.short) {
        assert!(*count >= PAYLOADS, "{name} was present only {count} times");
    }
    eprintln!(
        "{}: {} messages, {signals} signals ({} past their message), {} payloads, {} values compared",
        path.file_name().unwrap().display(),
        db.messages.len(),
        tally.short.len(),
        tally.payloads,
        tally.values
    );
    tally
}

fn compare_payload(message: &Message, payload: &[u8], expected: &mut HashMap<String, f64>, tally: &mut Tally) {
    for (_, signal) in message.signals.iter().enumerate().filter(|(n, _)| is_present(message, *n, payload)) {
        let name = format!("{}.{}", message.name, signal.name);
        let found = signal.layout.plan().unwrap().physical(payload);
        let Some(wanted) = expected.remove(&signal.name) else {
            assert_eq!(found, Err(Fault::ShortFrame), "cantools finds no {name} in {}", hex(payload));
            *tally.short.entry(name).or_default() += 1;
            continue;
        };
        if wanted.is_finite() {
            let found = found.unwrap();
            let close = (found - wanted).abs() <= 1e-9 * wanted.abs().max(1e-9);
            assert!(close, "{name} in {}: {found}, cantools {wanted}", hex(payload));
        } else {
            // If the raw or the scaled value is invalid, no value may be returned.
            let plan = signal.layout.plan().unwrap();
            let fault = plan.decode(payload).unwrap_err();
            assert!(matches!(fault, Fault::NotFinite | Fault::OutOfRange), "{name} in {}: {fault:?}", hex(payload));
        }
        tally.values += 1;
        *tally.per_signal.entry(name).or_default() += 1;
    }
    assert!(expected.is_empty(), "cantools alone finds {expected:?} of {} in {}", message.name, hex(payload));
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn tesla_dbc_signals_decode_as_cantools() {
    let path = measured::path("can_ev/tesla_model3.dbc");
    let Some(python) = python() else { return };
    let tally = compare(&python, &path, false);
    let past: BTreeSet<String> = ask(&python, &path, &["short"], &[]).into_iter().collect();
    assert_eq!(tally.short.keys().cloned().collect::<BTreeSet<_>>(), past, "signals that extend past their message");
    assert!(!past.is_empty() && tally.per_signal.len() > 3000);
    eprintln!("signals that extend past their message, so that every frame is too short: {past:?}");
}

#[test]
fn shipped_dbc_signals_decode_as_cantools() {
    let Some(python) = python() else { return };
    for name in ["packwatch.dbc", "pack96.dbc", "measured.dbc"] {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config").join(name);
        assert!(compare(&python, &path, true).short.is_empty());
    }
}

/// A DBC with nested pages, code ranges, two parallel multiplexors, an extended identifier, both byte orders, floats,
/// 64 bits across nine bytes, and a payload of 64 bytes.
const EXTENDED: &str = r#"VERSION ""

NS_ :

BS_:

BU_: A

BO_ 2566834709 Nested: 16 A
 SG_ Outer M : 0|8@1+ (1,0) [0|0] "" A
 SG_ Inner m3M : 15|8@0+ (1,0) [0|0] "" A
 SG_ Always : 16|8@1- (0.5,-3) [0|0] "" A
 SG_ Middle m3 : 31|12@0- (1,0) [0|0] "" A
 SG_ Deep m7 : 64|16@1+ (0.001,0) [0|0] "V" A
 SG_ Single m4 : 96|32@1- (1,0) [0|0] "" A

BO_ 512 Beside: 8 A
 SG_ Left M : 0|4@1+ (1,0) [0|0] "" A
 SG_ Right M : 7|4@0+ (1,0) [0|0] "" A
 SG_ LeftA m0 : 8|13@1- (0.25,1) [0|0] "" A
 SG_ LeftB m1 : 8|20@1+ (1,0) [0|0] "" A
 SG_ RightA m0 : 39|13@0- (0.1,0) [0|0] "" A
 SG_ RightB m2 : 39|24@0+ (1,0) [0|0] "" A

BO_ 513 Long: 64 A
 SG_ NineBytes : 3|64@1- (1,0) [0|0] "" A
 SG_ NineBytesBig : 130|64@0+ (1,0) [0|0] "" A
 SG_ Double : 256|64@1- (2,1) [0|0] "" A
 SG_ SingleBig : 391|32@0- (1,0) [0|0] "" A
 SG_ LastBit : 511|1@1+ (1,0) [0|0] "" A

SG_MUL_VAL_ 2566834709 Inner Outer 3-3;
SG_MUL_VAL_ 2566834709 Middle Outer 3-5, 9-9;
SG_MUL_VAL_ 2566834709 Deep Inner 7-8, 200-255;
SG_MUL_VAL_ 2566834709 Single Outer 4-6;
SG_MUL_VAL_ 512 LeftA Left 0-0, 5-7;
SG_MUL_VAL_ 512 LeftB Left 1-3;
SG_MUL_VAL_ 512 RightA Right 0-1;
SG_MUL_VAL_ 512 RightB Right 2-2, 15-15;
SIG_VALTYPE_ 2566834709 Single : 1;
SIG_VALTYPE_ 513 Double : 2;
SIG_VALTYPE_ 513 SingleBig : 1;
"#;

#[test]
fn extended_multiplexing_decodes_as_cantools() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("extended.dbc");
    std::fs::write(&path, EXTENDED).unwrap();
    let tally = compare(&python, &path, true);
    assert!(tally.short.is_empty());
    assert_eq!(tally.per_signal.len(), 17);
}

#[test]
fn alarm_rules_match_shipped_value_table() {
    let db = default_database().unwrap();
    let table = &db.signal("PACKWATCH_Alarm.Rule").unwrap().1.values;
    for rule in Rule::ALL {
        let named = (i64::from(rule as u8), format!("{rule:?}"));
        assert!(table.contains(&named), "{named:?}");
    }
    assert_eq!(table.len(), Rule::ALL.len() + 1, "all rules, and `not available`");
}
