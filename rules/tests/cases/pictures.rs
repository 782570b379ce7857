//! Cases of operations on pixels.

use gleaner_rules::pixels::{Encoding, PixelError, PixelErrorKind, Roi, View, ops};
use serde_json::{Value, json};

use crate::{replay, text};

fn number(given: &Value) -> u32 {
    u32::try_from(given.as_u64().unwrap()).unwrap()
}

fn bytes(hex: &str) -> Vec<u8> {
    (0..hex.len()).step_by(2).map(|at| u8::from_str_radix(&hex[at..at + 2], 16).unwrap()).collect()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn roi(given: &Value) -> Option<Roi> {
    let numbers = given.as_array()?;
    let [x, y, width, height] = [0, 1, 2, 3].map(|at| number(&numbers[at]));
    Some(Roi { x, y, width, height })
}

/// Returns the result, or kind and message of the error.
fn reply(result: Result<Value, PixelError>) -> Value {
    result.unwrap_or_else(|error| {
        let kind = match error.kind() {
            PixelErrorKind::OutOfRange => "out-of-range",
            PixelErrorKind::Unreadable => "not-a-frame",
            PixelErrorKind::Stopped => unreachable!("there is no stop check"),
        };
        let message = error.to_string();
        // Each side lists the supported encodings in its own order.
        json!([kind, message.split("; supported are").next()])
    })
}

#[test]
fn pixels() {
    replay("pixels", include_str!("../../cases/pixels.json"), |given| {
        let (given, data) = (given.clone(), bytes(text(&given["data"])));
        Box::new(move |call, arguments| {
            let [width, height, step] = ["width", "height", "step"].map(|key| number(&given[key]));
            let view = Encoding::from_ros(text(&given["encoding"])).and_then(|encoding| {
                View::new(width, height, step, encoding, given["big_endian"] == true, &data)
            });
            reply(view.and_then(|view| match call {
                "mean luma" => ops::mean_luma(&view, roi(&arguments[0])).map(Value::from),
                "histogram" => {
                    let counts = ops::histogram(&view, roi(&arguments[0]))?;
                    let there = counts.iter().enumerate().filter(|(_, count)| **count > 0);
                    Ok(there.map(|(level, count)| json!([level, count])).collect())
                }
                "to gray" => {
                    let mut out = vec![0; width as usize * height as usize];
                    ops::to_gray(&view, &mut out)?;
                    Ok(json!(["mono8", hex(&out)]))
                }
                "resize" => {
                    let [width, height] = [0, 1].map(|at| number(&arguments[at]));
                    let (encoding, needed) = ops::resized(&view, width, height)?;
                    let mut out = vec![0; needed];
                    ops::resize(&view, width, height, &mut out)?;
                    Ok(json!([encoding.name(), hex(&out)]))
                }
                other => panic!("{other}"),
            }))
        })
    });
}
