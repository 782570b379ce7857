//! Small charts as SVG, which state in words what they show.

use gleaner_protocol::DurationStats;
use maud::{Markup, html};

/// Renders parts of a whole as one bar with a legend. Each part has a class of the style, a name
/// and a number.
pub(super) fn parts(label: &str, parts: &[(&str, &str, u64)]) -> Markup {
    let total: u64 = parts.iter().map(|(_, _, number)| number).sum();
    let mut start = 0;
    let places: Vec<_> = parts
        .iter()
        .map(|(class, _, number)| {
            let place = (class, percent(start, total), percent(*number, total));
            start += number;
            place
        })
        .collect();
    let words: Vec<_> = parts.iter().map(|(_, name, number)| format!("{number} {name}")).collect();
    html! {
        figure.chart {
            svg.bar role="img" aria-label=(format!("{label}: {}", words.join(", ")))
                width="100%" height="10" {
                rect.ground width="100%" height="10" {}
                @for (class, x, width) in places {
                    rect class=(class) x=(x) width=(width) height="10" {}
                }
            }
            figcaption aria-hidden="true" {
                @for (class, name, number) in parts {
                    span.legend {
                        svg.swatch width="9" height="9" {
                            rect class=(class) width="9" height="9" rx="2" {}
                        }
                        b { (gleaner_base::grouped(number)) } " " (name) }
                }
            }
        }
    }
}

/// Renders a share of a maximum as a bar.
pub(super) fn share(value: f64, most: f64) -> Markup {
    let share = if most > 0.0 { (value / most).clamp(0.0, 1.0) } else { 0.0 };
    let class = if value > most { "failed" } else { "running" };
    html! {
        svg.bar aria-hidden="true" width="100%" height="8" {
            rect.ground width="100%" height="8" {}
            rect class=(class) width=(format!("{:.1}%", share * 100.0)) height="8" {}
        }
    }
}

/// Renders durations on a logarithmic scale from 1 µs to 10 s: a line from the median to p99, and a
/// dot at the maximum.
pub(super) fn spread(stats: &DurationStats) -> Markup {
    let place = |ns: u64| {
        let decades = (ns.max(1000) as f64 / 1000.0).log10();
        2.0 + (decades / 7.0).clamp(0.0, 1.0) * 96.0
    };
    let (p50, p99, max) = (place(stats.p50_ns), place(stats.p99_ns), place(stats.max_ns));
    html! {
        svg.bar aria-hidden="true" width="100%" height="12" {
            line.axis x1="2%" x2="98%" y1="6" y2="6" {}
            @for decade in 0..8 {
                @let x = format!("{:.1}%", 2.0 + f64::from(decade) / 7.0 * 96.0);
                line.axis x1=(x) x2=(x) y1="3" y2="9" {}
            }
            line.range x1=(format!("{p50:.1}%")) x2=(format!("{p99:.1}%")) y1="6" y2="6" {}
            circle.running cx=(format!("{p50:.1}%")) cy="6" r="4" {}
            circle.failed cx=(format!("{max:.1}%")) cy="6" r="2.5" {}
        }
    }
}

/// Renders moments of a time span, each as its share of the span.
pub(super) fn ticks(shares: impl Iterator<Item = f64>) -> Markup {
    html! {
        svg.bar.ticks aria-hidden="true" width="100%" height="20" {
            rect.ground width="100%" height="20" {}
            @for share in shares {
                @let x = format!("{:.2}%", share.clamp(0.0, 1.0) * 100.0);
                line.range x1=(x) x2=(x) y1="3" y2="17" {}
            }
        }
    }
}

fn percent(number: u64, total: u64) -> String {
    format!("{:.3}%", number as f64 * 100.0 / total.max(1) as f64)
}
