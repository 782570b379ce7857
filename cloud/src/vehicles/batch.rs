//! Parses the records that a vehicle sends.

use std::ops::Range;

use gleaner_base::excerpt;
use gleaner_fleet::{Cursor, RECORDS_MAX, Records, decompress};
use gleaner_lambda::manifest::ItemName;
use gleaner_protocol::vehicle_api::StreamLine;
use serde_json::json;

use crate::error::{CloudError, CloudResult};
use crate::store::{NUMBER_MAX, StreamBatch, name_in_lines};

/// Kinds of lines that are no records: gaps and damage.
const MARKS: [&str; 3] = ["gap", "torn", "damaged"];

/// Parses records. A line that cannot be parsed is replaced by one with the reason: refused, the
/// vehicle would send it for ever.
/// Fails if the stream has no name of one, or the lines cannot be decompressed.
pub(super) fn parse(records: &Records) -> CloudResult<StreamBatch> {
    let Records { stream, life, next, lines } = records;
    let lambda = stream.strip_prefix("lambdas/").map(str::parse::<ItemName>);
    if !matches!(&**stream, "events" | "orchestrator") && !matches!(lambda, Some(Ok(_))) {
        let message = format!("`{}` is not a stream", excerpt(stream));
        let help = "the streams are `events`, `orchestrator` and `lambdas/ID`";
        return Err(CloudError::usage(message, help));
    }
    let lines = decompress(lines).map_err(|error| {
        let help = "use a version of gleaner that fits the one of the cloud";
        CloudError::usage(format!("records of `{stream}` cannot be used"), help).because(error)
    })?;
    let of_lines = || lines.split(|byte| *byte == b'\n').filter(|line| !line.is_empty());
    if of_lines().take(RECORDS_MAX + 1).count() > RECORDS_MAX {
        let message = format!("a frame has more than {RECORDS_MAX} records of `{stream}`");
        let help = "use a version of gleaner that fits the one of the cloud";
        return Err(CloudError::usage(message, help));
    }
    let name = name_in_lines(stream);
    let cursor = Cursor { stream: stream.clone(), life: *life, next: *next, ..Cursor::default() };
    let (mut batch, mut first) = (StreamBatch { lines: Vec::new(), cursor }, 0);
    for text in of_lines() {
        let line = serde_json::from_slice::<StreamLine>(text).map_err(|error| error.to_string());
        let line = line.and_then(|line| of_stream(line, name, first..*next));
        // Parsed as JSON, the line is UTF-8, and a carriage return is between its tokens.
        let (line, text) = match (line, std::str::from_utf8(text)) {
            (Ok(line), Ok(text)) => (line, text.replace('\r', " ")),
            (line, _) => damaged(name, &line.err().unwrap_or_default(), text),
        };
        let mark = match is_mark(&line) {
            true => gleaner_trust::sha256(text.as_bytes()).to_string(),
            false => String::new(),
        };
        if mark.is_empty() {
            let Cursor { seq, boot, boot_ns, .. } = &mut batch.cursor;
            (*seq, *boot_ns) = (line.seq, line.boot_ns);
            boot.clone_from(&line.boot);
            first = line.seq + 1;
        }
        batch.lines.push((line.seq, mark, text));
    }
    Ok(batch)
}

/// Returns a line if it is one of the stream with a number in `seqs`.
fn of_stream(line: StreamLine, stream: &str, seqs: Range<u64>) -> Result<StreamLine, String> {
    let StreamLine { seq, boot_ns, .. } = line;
    let reason = match () {
        // A torn end may have the number of the next record.
        () if line.stream != stream || (!is_mark(&line) && seq >= seqs.end) => {
            format!("it is record {seq} of `{}`", excerpt(&line.stream))
        }
        () if !is_mark(&line) && seq < seqs.start => {
            format!("it is record {seq}, after record {}", seqs.start - 1)
        }
        () if seq > NUMBER_MAX => format!("its `seq` is {seq}, above 2^62"),
        () if boot_ns > NUMBER_MAX => format!("its `boot_ns` is {boot_ns}, above 2^62"),
        // PostgreSQL stores no text with it.
        () if line.boot.contains('\0') => "its `boot` has a zero byte".to_owned(),
        () => return Ok(line),
    };
    Err(reason)
}

fn is_mark(line: &StreamLine) -> bool {
    MARKS.contains(&&*line.kind)
}

fn damaged(stream: &str, reason: &str, line: &[u8]) -> (StreamLine, String) {
    let text = format!("the cloud cannot read a line of {} bytes: {reason}", line.len());
    let line = StreamLine {
        stream: stream.to_owned(),
        kind: "damaged".to_owned(),
        record: json!({ "text": excerpt(&text) }),
        ..StreamLine::default()
    };
    let text = serde_json::to_string(&line).unwrap_or_default();
    (line, text)
}

#[cfg(test)]
mod tests {
    use gleaner_fleet::compress;

    use super::*;

    fn line(seq: u64, kind: &str) -> String {
        json!({ "stream": "events", "seq": seq, "time_ns": 1, "boot_ns": seq, "boot": "b",
                "kind": kind, "record": {} })
        .to_string()
    }

    #[test]
    fn lines_that_are_no_records_are_replaced_and_gaps_are_marked() {
        let text =
            format!("{}\n{}\nnonsense\n{}\n", line(4, "event"), line(5, "gap"), line(9, "x"));
        let records = Records {
            stream: "events".to_owned(),
            life: 1,
            next: 9,
            lines: compress(text.as_bytes()),
        };
        let batch = parse(&records).unwrap();
        let marks: Vec<_> =
            batch.lines.iter().map(|(seq, mark, _)| (*seq, !mark.is_empty())).collect();
        assert_eq!(marks, [(4, false), (5, true), (0, true), (0, true)]);
        assert!(batch.lines[2].2.contains("cannot read a line of 8 bytes"), "{:?}", batch.lines);
        assert_eq!((batch.cursor.next, batch.cursor.seq), (9, 4));
        // Readers of events would take a carriage return for the end of a line.
        let text = line(4, "event").replace(',', ",\r");
        let batch =
            parse(&Records { lines: compress(text.as_bytes()), ..records.clone() }).unwrap();
        assert_eq!(batch.lines[0].2, line(4, "event").replace(',', ", "));
        // Each record has a number of its own that the database can hold.
        let late = line(5, "event").replace("\"boot_ns\":5", "\"boot_ns\":4611686018427387905");
        let lines = [line(4, "event"), line(4, "log"), late, line(u64::MAX, "gap")].join("\n");
        let batch =
            parse(&Records { lines: compress(lines.as_bytes()), ..records.clone() }).unwrap();
        assert_eq!((batch.lines.len(), batch.cursor.seq), (4, 4));
        let reasons = ["after record 4", "its `boot_ns` is", "its `seq` is"];
        let mut others = batch.lines[1..].iter().zip(reasons);
        assert!(others.all(|(line, reason)| line.2.contains(reason)), "{:?}", batch.lines);
        // Lines of a lambda have its id, as on the vehicle.
        let text = line(4, "log").replace("events", "brake");
        let stream = "lambdas/brake".to_owned();
        let lambda = Records { stream, lines: compress(text.as_bytes()), ..records.clone() };
        assert_eq!(parse(&lambda).unwrap().lines, [(4, String::new(), text)]);
        let other = Records { stream: "lambdas/../x".to_owned(), ..records.clone() };
        assert!(parse(&other).is_err());
        // A small frame must not become a large transaction.
        let many = Records { lines: compress(&b"x\n".repeat(RECORDS_MAX + 1)), ..records };
        let refused = parse(&many).unwrap_err().reason();
        assert!(refused.contains("more than 4000 records of `events`"), "{refused}");
    }
}
