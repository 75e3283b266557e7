//! Compares drawn screens with the files in `screens/`. `PACKWATCH_WRITE_SCREENS=1 cargo test screens` rewrites the
//! files; check the new files before a commit.

use std::path::PathBuf;

use ratatui::Terminal;
use ratatui::backend::TestBackend;
use ratatui::style::Color;

use super::app::{FeedUpdate, HISTORY, Page};
use super::*;
use crate::cli::status::sample::sample;
use crate::quantity::Timestamp;
use crate::quantity::catalogue::{Estimate, PackValues, Quantity};
use crate::status::document::StatusDocument;

fn app() -> App {
    App::new(PathBuf::from("/run/packwatch/status.sock"), true)
}

/// Returns a view that has received documents of a pack for `seconds`.
fn watched(cells: u16, seconds: usize) -> App {
    let mut app = app();
    for second in 0..seconds {
        let mut document = sample(cells);
        document.wall_time = document.wall_time.plus_secs(second as f64);
        for cell in &mut document.cells {
            let wave = (second as f64 / 10.0 + f64::from(cell.cell.0)).sin();
            let moved = |quantity, by: f64| cell.values.get(quantity).map(|it| Estimate { mean: it.mean + by, ..it });
            let voltage = moved(Quantity::Voltage, 0.02 * wave);
            let soc = moved(Quantity::Soc, -0.0005 * second as f64);
            cell.values = cell.values.with(Quantity::Voltage, voltage).with(Quantity::Soc, soc);
        }
        app.poll(document.wall_time);
        app.handle_update(FeedUpdate::StatusDocument(Box::new(document)));
    }
    app
}

fn drawn(app: &mut App, (width, height): (u16, u16)) -> TestBackend {
    let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
    terminal.draw(|frame| draw::draw(frame, app)).unwrap();
    terminal.backend().clone()
}

fn check(name: &str, app: &mut App, size: (u16, u16)) {
    let found = drawn(app, size).to_string();
    let file =
        PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("src/cli/status/view/screens").join(format!("{name}.txt"));
    if std::env::var_os("PACKWATCH_WRITE_SCREENS").is_some() {
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        std::fs::write(&file, &found).unwrap();
    }
    let wanted = std::fs::read_to_string(&file).unwrap_or_default();
    assert!(wanted == found, "{name} differs from its file:\n{found}");
}

const SMALL: (u16, u16) = (80, 24);
const LARGE: (u16, u16) = (120, 40);

#[test]
fn cell_screens_match_files() {
    for (name, cells, size) in [
        ("cells_1_80x24", 1, SMALL),
        ("cells_1_120x40", 1, LARGE),
        ("cells_96_80x24", 96, SMALL),
        ("cells_96_120x40", 96, LARGE),
        ("cells_1024_120x40", 1024, LARGE),
    ] {
        check(name, &mut watched(cells, 100), size);
    }
    let mut app = watched(1024, 3);
    drawn(&mut app, SMALL);
    app.handle_key(KeyCode::Char('v'));
    app.handle_key(KeyCode::End);
    check("cells_1024_80x24_voltage_last", &mut app, SMALL);
}

#[test]
fn page_screens_match_files() {
    let mut app = watched(96, 3);
    for page in [Page::Alarms, Page::Interfaces, Page::Counts, Page::Events] {
        app.handle_key(KeyCode::Tab);
        assert_eq!(app.page, page);
        check(&format!("{}_80x24", page.name()), &mut app, SMALL);
    }
    app.handle_key(KeyCode::Tab);
    assert_eq!(app.page, Page::Cells);
}

#[test]
fn lost_daemon_screens_match_files() {
    check("waiting_80x24", &mut app(), SMALL);
    let mut app = watched(96, 3);
    app.handle_update(FeedUpdate::Lost("/run/packwatch/status.sock: no daemon listens there".to_owned()));
    app.handle_update(FeedUpdate::Lost("/run/packwatch/status.sock: no daemon listens there".to_owned()));
    check("lost_80x24", &mut app, SMALL);
    // No stale value remains on the screen.
    assert!(!drawn(&mut app, LARGE).to_string().contains("SOC"));
    app.handle_update(FeedUpdate::StatusDocument(Box::new(sample(96))));
    assert!(drawn(&mut app, LARGE).to_string().contains("SOC"));
}

#[test]
fn silent_daemon_is_reported_as_lost() {
    let mut app = watched(1, 1);
    let received_at = sample(1).wall_time;
    app.poll(received_at.plus_secs(2.9));
    assert!(app.document.is_some());
    app.poll(received_at.plus_secs(3.1));
    assert!(app.document.is_none());
    assert_eq!(app.lost.as_ref().map(|(since, _)| *since), Some(Some(received_at)));
}

#[test]
fn unknown_soc_is_drawn_as_unknown() {
    let mut document = StatusDocument { cells: Vec::new(), ..sample(2) };
    document.pack.values = PackValues::default();
    let mut app = app();
    app.handle_update(FeedUpdate::StatusDocument(Box::new(document)));
    let screen = drawn(&mut app, SMALL).to_string();
    assert!(screen.contains("SOC       - ····") && screen.contains("unknown"), "{screen}");
}

#[test]
fn silent_cell_is_not_drawn_as_trusted() {
    let mut app = app();
    app.handle_update(FeedUpdate::StatusDocument(Box::new(sample(3))));
    let screen = drawn(&mut app, SMALL);
    // The first row of the map shows a trusted, an untrusted and a silent cell. The first cell is selected.
    let row =
        (0..SMALL.1).find(|row| (0..5).map(|x| screen.buffer()[(x, *row)].symbol()).eq([" ", " ", " ", "1", " "]));
    let colours: Vec<Color> = [5, 9, 13].map(|x| screen.buffer()[(x, row.unwrap())].fg).to_vec();
    assert_eq!(colours, [Color::Green, Color::Red, Color::Reset]);
}

#[test]
fn all_sizes_and_keys_draw_without_panic() {
    for cells in [1, 2, 96, 1024] {
        let mut app = watched(cells, 2);
        for size in [(1, 1), (40, 12), (41, 13), (57, 30), (200, 12), (80, 24), (300, 100)] {
            for _ in Page::ALL {
                for key in [
                    KeyCode::End,
                    KeyCode::PageDown,
                    KeyCode::Down,
                    KeyCode::Right,
                    KeyCode::Up,
                    KeyCode::PageUp,
                    KeyCode::Left,
                    KeyCode::Home,
                ] {
                    drawn(&mut app, size);
                    app.handle_key(key);
                    assert!(app.selected < usize::from(cells));
                }
                app.handle_key(KeyCode::Tab);
            }
        }
    }
}

#[test]
fn history_length_is_bounded() {
    let app = watched(2, HISTORY + 5);
    assert!(app.history.iter().all(|points| points.len() == HISTORY));
}

#[test]
fn theme_without_colour_draws_no_colour() {
    let mut app = watched(96, 2);
    let colours =
        |backend: &TestBackend| backend.buffer().content().iter().filter(|cell| cell.fg != Color::Reset).count();
    assert!(colours(&drawn(&mut app, SMALL)) > 0);
    app.has_colour = false;
    for _ in Page::ALL {
        assert_eq!(colours(&drawn(&mut app, SMALL)), 0, "{:?}", app.page);
        app.handle_key(KeyCode::Tab);
    }
    assert!(Timestamp::ZERO < feed::now());
}

#[test]
fn keys_match_help_line() {
    let key = |code| meaning(KeyEvent::new(code, KeyModifiers::NONE));
    assert_eq!(key(KeyCode::Char('q')), Some(KeyCode::Esc));
    assert_eq!(key(KeyCode::Tab), Some(KeyCode::Tab));
    assert_eq!(key(KeyCode::Char('x')), None);
    assert_eq!(meaning(KeyEvent::new(KeyCode::Char('c'), KeyModifiers::CONTROL)), Some(KeyCode::Esc));
}
