//! One record of a vehicle as a line of the page.

use gleaner_lambda::{Decision, LogLevel, LogLine, Trigger};
use gleaner_protocol::supervision::VehicleEvent;
use gleaner_protocol::vehicle_api::StreamLine;
use maud::{Markup, html};
use serde::de::DeserializeOwned;
use serde_json::Value;

use super::text::{block, shown, time_of_day};

/// Maximum number of triggers of a decision, and of attributes of a trigger, that are shown.
const TRIGGERS_MAX: usize = 8;
const ATTRIBUTES_MAX: usize = 8;

/// Words of a record, with the class of their style.
struct RecordWords {
    kind: String,
    class: &'static str,
    words: Markup,
}

/// Renders a record. `has_stream` adds the name of the lambda that it is of.
pub(super) fn line(text: &str, has_stream: bool) -> Markup {
    let Ok(line) = serde_json::from_str::<StreamLine>(text) else {
        return html! { div.line { span.kind.bad { "damaged" } span.words { (shown(text)) } } };
    };
    let RecordWords { kind, class, words } = words_of(&line);
    let is_of_lambda = !["events", "orchestrator"].contains(&&*line.stream);
    html! {
        div.line {
            (time_of_day(line.time_ns))
            span.kind.(class) { (kind) }
            span.words {
                @if has_stream && is_of_lambda { b { (shown(&line.stream)) ": " } }
                (words)
            }
        }
    }
}

/// Returns whether a record belongs to the time line of its vehicle: all but log lines do.
pub(super) fn is_of_time_line(text: &str) -> bool {
    #[derive(serde::Deserialize)]
    struct KindOfLine {
        kind: String,
    }
    serde_json::from_str::<KindOfLine>(text).is_ok_and(|it| it.kind != "log")
}

fn words_of(line: &StreamLine) -> RecordWords {
    let StreamLine { kind, record, seq, .. } = line;
    match &**kind {
        "event" => parsed(record).map(event),
        "log" => parsed(record).map(log),
        "decision" => parsed(record).map(decision),
        "gap" | "torn" | "damaged" => Some(gap(kind, *seq, record)),
        "large" => Some(large(record)),
        "started" => Some(started(record)),
        _ => None,
    }
    .unwrap_or_else(|| RecordWords {
        kind: shown(kind),
        class: "",
        words: html! { code { (shown(&record.to_string())) } },
    })
}

fn parsed<T: DeserializeOwned>(record: &Value) -> Option<T> {
    T::deserialize(record).ok()
}

fn event(event: VehicleEvent) -> RecordWords {
    let kind = serde_json::to_value(event.event).unwrap_or_default();
    let kind = kind.as_str().unwrap_or_default().replace('_', " ");
    let class = match &*kind {
        "failed" | "quarantined" | "refused" | "loss" => "bad",
        "warning" | "rolled back" => "warn",
        "ready" | "clip" | "deployed" => "good",
        _ => "",
    };
    let words = html! {
        @if let Some(lambda) = &event.lambda { b { (shown(lambda)) ": " } }
        (shown(&event.text))
    };
    RecordWords { kind, class, words }
}

fn log(line: LogLine) -> RecordWords {
    let (kind, class) = match line.level {
        LogLevel::Error => ("error", "bad"),
        LogLevel::Warn => ("warn", "warn"),
        LogLevel::Info => ("info", ""),
        LogLevel::Debug => ("debug", "dim"),
        LogLevel::Trace => ("trace", "dim"),
    };
    RecordWords { kind: kind.to_owned(), class, words: html! { (block(&line.message)) } }
}

fn decision(decision: Decision) -> RecordWords {
    let triggers = &decision.triggers;
    let (kind, class) = match (&decision.fault, triggers.is_empty()) {
        (Some(_), _) => ("fault", "bad"),
        (None, false) => ("trigger", "good"),
        (None, true) => ("decision", "dim"),
    };
    let words = html! {
        @for (index, it) in triggers.iter().take(TRIGGERS_MAX).enumerate() {
            @if index > 0 { ", " }
            (trigger(it))
        }
        @if triggers.len() > TRIGGERS_MAX { ", and " (triggers.len() - TRIGGERS_MAX) " more" }
        @if let Some(fault) = &decision.fault {
            @let kind = serde_json::to_value(fault.kind).unwrap_or_default();
            @if !triggers.is_empty() { ", " }
            (kind.as_str().unwrap_or_default()) ": " (block(&fault.message))
        } @else if triggers.is_empty() { "nothing" }
    };
    RecordWords { kind: kind.to_owned(), class, words }
}

fn trigger(trigger: &Trigger) -> Markup {
    html! {
        @if trigger.kind.as_str() != "event" { (trigger.kind.as_str()) " " }
        b { (shown(&trigger.label)) }
        @if let Some(score) = trigger.score { " " (super::text::score(score)) }
        @if !trigger.attributes.is_empty() {
            span.dim {
                @for (name, value) in trigger.attributes.iter().take(ATTRIBUTES_MAX) {
                    " " (shown(name)) "=" (shown(&value.to_string()))
                }
            }
        }
    }
}

fn gap(kind: &str, first: u64, record: &Value) -> RecordWords {
    let last = record.get("to").and_then(Value::as_u64).unwrap_or(first);
    let count = record.get("records").and_then(Value::as_u64);
    let reason = record.get("reason").and_then(Value::as_str).unwrap_or("unknown");
    let words = html! {
        @match count {
            Some(count) => { (gleaner_base::grouped(count)) " records up to number " (last) },
            None => { "records " (first) " to " (last) },
        }
        " are missing: " (shown(reason))
    };
    RecordWords { kind: shown(kind), class: "bad", words }
}

fn large(record: &Value) -> RecordWords {
    let text = record.get("text").and_then(Value::as_str).unwrap_or_default();
    RecordWords { kind: "large".to_owned(), class: "warn", words: html! { (shown(text)) } }
}

fn started(record: &Value) -> RecordWords {
    let text = |name: &str| record.get(name).and_then(Value::as_str).unwrap_or_default();
    let words = html! { "a process of revision " code { (super::text::short(text("revision"))) } };
    RecordWords { kind: "started".to_owned(), class: "", words }
}
