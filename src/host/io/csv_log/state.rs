//! Reads the direction of the current from a state column, and gives the current its sign.
//!
//! In: states such as `D`, `CC_DChg`, `Entladen` or `Not charging`, and currents with or without a sign. Out: the
//! [`Direction`], and the current with positive = discharge. `None` stands for a state without a direction, and for a
//! current whose sign is unknown.

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Direction {
    Charge,
    Discharge,
}

/// Parts of words for a discharge, without accents.
const DISCHARGE: &str = "disch dsg entlad ontlad utlad urlad aflad descarg scaric rozlad \
    \u{440}\u{430}\u{437}\u{440}\u{44f}\u{434} \u{653e}\u{7535} \u{653e}\u{96fb}";
/// Beginnings of words for a discharge. Inside a word, these letters do not count, because they may belong to two
/// words, as `dch` does in `gridcharging`.
const DISCHARGE_START: [&str; 3] = ["dch", "dsch", "dech"];
const CHARGE: &str = "charg chrg chg regen lade ladu ladd ladn ladi ladow carga caric \
    \u{437}\u{430}\u{440}\u{44f}\u{434} \u{5145}\u{7535} \u{5145}\u{96fb}";
const REST: &str = "r p s o rest resting pau pause pse idle stand standby ocv ocp wait waiting ruhe relax repos stop stopped open off end ready \
    full float finished none \u{9759}\u{7f6e} \u{6401}\u{7f6e} \u{4f11}\u{6b62}";
const NEGATION: &str = "not no non nicht kein keine without";

fn words(state: &[u8]) -> Vec<String> {
    let mut text = String::new();
    let (state, mut last) = (String::from_utf8_lossy(state), ' ');
    let mut chars = state.chars().peekable();
    while let Some(c) = chars.next() {
        if last.is_lowercase() && c.is_uppercase() && chars.peek().is_some_and(|next| next.is_alphabetic()) {
            text.push(' ');
        }
        text.push(c);
        last = c;
    }
    let text = text.to_lowercase().replace("notch", "not ch").replace("notd", "not d");
    let plain = text.chars().map(|c| match c {
        '\u{e8}'..='\u{eb}' => 'e',
        '\u{e0}'..='\u{e5}' => 'a',
        '\u{142}' => 'l',
        c => c,
    });
    let plain: String = plain.collect();
    plain.split(|c: char| !c.is_alphanumeric()).filter(|word| !word.is_empty()).map(str::to_owned).collect()
}

pub(super) fn is_rest(state: &[u8]) -> bool {
    let words = words(state);
    let is_any = |list: &str| words.iter().any(|word| list.split(' ').any(|of| of == word));
    is_any(NEGATION) || (is_any(REST) && direction(state).is_none())
}

/// Reads the direction from a state; `None` for a rest and for an unknown state.
pub(super) fn direction(state: &[u8]) -> Option<Direction> {
    let words = words(state);
    let is = |list: &str| words.iter().any(|word| list.split(' ').any(|of| of == word));
    let has = |parts: &str| words.iter().any(|word| parts.split(' ').any(|part| word.contains(part)));
    let is_divided = words.windows(2).any(|pair| ["d", "dis", "de"].contains(&&*pair[0]) && pair[1].starts_with("ch"));
    // The word may directly follow `CC`, `CV`, `CP` or `CR`, as in `CCDChg`.
    let bare = |word: &String| word.trim_start_matches(|c: char| c.is_ascii_digit() || "cvpr".contains(c)).to_owned();
    let is_begun = words.iter().map(bare).any(|word| DISCHARGE_START.iter().any(|start| word.starts_with(start)));
    match () {
        () if is(NEGATION) => None,
        () if is("d dis ent") || is_divided || is_begun || has(DISCHARGE) => Some(Direction::Discharge),
        // `PULSEDCHG` (a discharge) and `GRIDCHG` (a charge) cannot be told apart.
        () if has("dchg dchrg") => None,
        () if is("c ch cha lad") || has(CHARGE) => Some(Direction::Charge),
        () => None,
    }
}

/// What decides the sign of the current.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum SignSource {
    User,
    Format,
    State,
    Voltage,
    Nothing,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct CurrentSign {
    pub(super) is_charge_positive: bool,
    /// Whether the current is a magnitude whose sign the state column gives.
    pub(super) is_by_state: bool,
    /// Whether a charge with a positive current has occurred. If a discharge with a positive current has also
    /// occurred, the current is a magnitude.
    pub(super) has_positive_charge: bool,
    pub(super) has_positive_discharge: bool,
    /// Currents up to this size count as zero (A).
    pub(super) noise_a: f64,
    pub(super) codes: Vec<(Vec<u8>, Direction)>,
    pub(super) source: SignSource,
}

impl CurrentSign {
    pub(super) fn new(is_charge_positive: bool, source: SignSource) -> Self {
        Self {
            is_charge_positive,
            is_by_state: false,
            has_positive_charge: false,
            has_positive_discharge: false,
            noise_a: 0.0,
            codes: Vec::new(),
            source,
        }
    }

    pub(super) fn direction(&self, state: &[u8]) -> Option<Direction> {
        direction(state).or_else(|| self.codes.iter().find(|(code, _)| code == state).map(|of| of.1))
    }

    /// The current with positive = discharge. `None` if a magnitude is negative or flows without a direction.
    pub(super) fn discharge(&mut self, value: f64, direction: Option<Direction>) -> Option<f64> {
        if self.is_by_state {
            let Some(direction) = direction else { return (value.abs() <= self.noise_a).then_some(value) };
            let is_discharge = direction == Direction::Discharge;
            if value >= -self.noise_a {
                self.has_positive_charge |= !is_discharge && value > self.noise_a;
                self.has_positive_discharge |= is_discharge && value > self.noise_a;
                return Some(if is_discharge { value } else { -value });
            }
            if self.has_positive_charge && self.has_positive_discharge {
                return None;
            }
            // This first negative current shows that the current has a sign. The rows before it had only one
            // direction.
            self.is_by_state = false;
            self.is_charge_positive =
                if is_discharge { !self.has_positive_discharge } else { self.has_positive_charge };
        }
        let discharge_a = if self.is_charge_positive { -value } else { value };
        // If the state is a charge but the sign gives a discharge, the two contradict each other. The sign may come
        // from a single negative current.
        let is_contradicted = self.noise_a > 0.0 && direction == Some(Direction::Charge) && discharge_a > self.noise_a;
        (!is_contradicted).then_some(discharge_a)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn states_of_cyclers_give_direction() {
        for (state, expected) in [
            ("D", Some(Direction::Discharge)),
            ("C", Some(Direction::Charge)),
            ("CC DChg", Some(Direction::Discharge)),
            ("CC_Chg", Some(Direction::Charge)),
            ("CCCV Chg", Some(Direction::Charge)),
            ("DCH", Some(Direction::Discharge)),
            ("CHA", Some(Direction::Charge)),
            ("Discharging", Some(Direction::Discharge)),
            ("charging", Some(Direction::Charge)),
            ("Rest", None),
            ("PAU", None),
            ("R", None),
            ("0", None),
        ] {
            assert_eq!(direction(state.as_bytes()), expected, "{state}");
        }
    }

    #[test]
    fn words_of_languages_give_direction() {
        let all = |texts: &str, expected| {
            for text in texts.split(',') {
                assert_eq!(direction(text.as_bytes()), expected, "{text}");
            }
        };
        all(
            "DISCH,DSG,Dischrg,D\u{e9}charge,Entladen,DIS-CHG,CCDChg,D_CC,Dis Charge,descarga,dsch,PulseDChg,CCCVDCHG,DisCharge",
            Some(Direction::Discharge),
        );
        all(
            "GridCharging,ScheduledCharging,TimedCharge,gridcharging,ModeCharging,CHG,Chrg,Charge,Laden,C_CC,Mid-charge,2nd charge,Regen,Carga,CC-CV Cha",
            Some(Direction::Charge),
        );
        all("PULSEDCHG,SoC,Not charging,NotCharging,No discharge,Idle,Unknown,OK,1,change,Channel", None);
        assert!(["Not charging", "StandBy", "Rest", "PAU", "Idle", "R"].iter().all(|text| is_rest(text.as_bytes())));
        assert!(["CC", "Driving", "1", ""].iter().all(|text| !is_rest(text.as_bytes())));
    }
}
