//! Parses a command: a `std_msgs/msg/String` whose text is a JSON object.

use gleaner_lambda::{Trigger, TriggerKind};
use gleaner_messages::Endian;
use serde::Deserialize;

/// Longest label, in bytes: that of a lambda's trigger.
const LABEL_MAX: usize = 128;

#[derive(Debug, thiserror::Error)]
pub enum CommandError {
    #[error("the message has no text")]
    NoText,
    #[error("the text is not a command")]
    NoCommand { source: serde_json::Error },
    #[error("its label is empty")]
    NoLabel,
    #[error("its label has {bytes} bytes; at most {LABEL_MAX} are allowed")]
    LongLabel { bytes: usize },
    #[error("no recording lambda is connected yet")]
    NoLambdas,
    #[error("`lambda` has to name one of the {known} recording lambdas")]
    WhichLambda { known: usize },
    #[error("no recording lambda is named `{name}`")]
    NoSuchLambda { name: String },
    #[error("a recording `{label}` is running already, or too many are")]
    Running { label: String },
    #[error("no command started a running recording `{label}`")]
    NotRunning { label: String },
    #[error("too many windows wait for their clip")]
    TooMuch,
    #[error("too little free disk space: recording is suspended")]
    DiskSuppressed,
}

#[derive(Debug, PartialEq)]
pub struct CommandRequest {
    /// The lambda in whose name it is given.
    pub lambda: Option<String>,
    pub trigger: Trigger,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CommandText {
    command: TriggerKind,
    label: String,
    lambda: Option<String>,
    score: Option<f64>,
}

impl CommandRequest {
    /// Parses a message. The grant of the topic bounds its length.
    pub fn read(cdr: &[u8], endian: Endian) -> Result<CommandRequest, CommandError> {
        let CommandText { command: kind, label, lambda, score } =
            serde_json::from_str(text(cdr, endian)?)
                .map_err(|source| CommandError::NoCommand { source })?;
        match label.len() {
            0 => return Err(CommandError::NoLabel),
            bytes if bytes > LABEL_MAX => return Err(CommandError::LongLabel { bytes }),
            _ => {}
        }
        Ok(CommandRequest {
            lambda,
            trigger: Trigger { kind, label, score, attributes: serde_json::Map::new() },
        })
    }
}

/// Returns the text of a `std_msgs/msg/String`.
fn text(cdr: &[u8], endian: Endian) -> Result<&str, CommandError> {
    let found = || {
        let (len, rest) = cdr.split_first_chunk::<4>()?;
        let len = match endian {
            Endian::Little => u32::from_le_bytes(*len),
            Endian::Big => u32::from_be_bytes(*len),
        };
        let text = rest.get(..usize::try_from(len).ok()?)?;
        std::str::from_utf8(text.strip_suffix(&[0])?).ok()
    };
    found().ok_or(CommandError::NoText)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(text: &str) -> Vec<u8> {
        let len = u32::try_from(text.len() + 1).unwrap();
        [&len.to_le_bytes()[..], text.as_bytes(), &[0]].concat()
    }

    fn read(text: &str) -> Result<CommandRequest, CommandError> {
        CommandRequest::read(&message(text), Endian::Little)
    }

    /// Returns the error of a text, with the error of the JSON parser.
    fn refused(text: &str) -> String {
        let error = read(text).unwrap_err();
        match &error {
            CommandError::NoCommand { source } => format!("{error}: {source}"),
            _ => error.to_string(),
        }
    }

    #[test]
    fn a_command_is_what_a_lambda_could_trigger() {
        let request = read(
            r#" {"command": "start", "label": "test \u001b[2J", "lambda": "brake", "score": 1e2} "#,
        )
        .unwrap();
        assert_eq!(request.lambda.as_deref(), Some("brake"));
        let Trigger { kind, label, score, attributes } = request.trigger;
        let expected = (TriggerKind::Start, "test \u{1b}[2J", Some(100.0));
        assert_eq!((kind, label.as_str(), score), expected);
        assert!(attributes.is_empty());
        let request = read(r#"{"label":"x","command":"event","lambda":null}"#).unwrap();
        assert_eq!((request.lambda, request.trigger.score), (None, None));
        let mut big = message(r#"{"label":"x","command":"stop"}"#);
        big[..4].reverse();
        let stop = CommandRequest::read(&big, Endian::Big).unwrap();
        assert_eq!(stop.trigger.kind, TriggerKind::Stop);
    }

    #[test]
    fn anything_else_is_refused_with_a_reason() {
        let whys = [
            ("", "EOF"),
            ("[]", "invalid length 0"),
            (r#"{"command":"event"}"#, "missing field `label`"),
            (r#"{"label":"x"}"#, "missing field `command`"),
            (r#"{"command":"erase","label":"x"}"#, "unknown variant `erase`"),
            (r#"{"command":"event","label":"x","at_ns":5}"#, "unknown field `at_ns`"),
            (r#"{"command":"event","label":"x","label":"y"}"#, "duplicate field `label`"),
            (r#"{"command":"event","label":5}"#, "expected a string"),
            (r#"{"command":"event","label":"x","score":1e999}"#, "out of range"),
            (r#"{"command":"event","label":"x"} {}"#, "trailing characters"),
            (r#"{"command":"event","label":""}"#, "its label is empty"),
        ];
        for (text, why) in whys {
            let refused = refused(text);
            assert!(refused.contains(why), "{text}: {refused}");
        }
        let label = "é".repeat(64);
        let text = |label: &str| format!(r#"{{"command":"event","label":"{label}"}}"#);
        assert_eq!(read(&text(&label)).unwrap().trigger.label, label);
        let error = refused(&text(&format!("{label}x")));
        assert_eq!(error, "its label has 129 bytes; at most 128 are allowed");
        assert!(matches!(read(&"[".repeat(4 << 10)), Err(CommandError::NoCommand { .. })));
    }

    #[test]
    fn broken_messages_have_no_text() {
        let good = message(r#"{"command":"event","label":"x"}"#);
        for len in 0..good.len() {
            let found = CommandRequest::read(&good[..len], Endian::Little);
            assert!(matches!(found, Err(CommandError::NoText)), "{len}");
        }
        let filled = [&good[..], &[0; 3]].concat();
        assert!(CommandRequest::read(&filled, Endian::Little).is_ok());
        for (at, byte) in [(0, 255), (3, 255), (0, 0), (9, 255), (good.len() - 1, b'x')] {
            let mut bad = good.clone();
            bad[at] = byte;
            let error = CommandRequest::read(&bad, Endian::Little).unwrap_err();
            assert!(matches!(error, CommandError::NoText), "{at}: {error}");
        }
    }
}
