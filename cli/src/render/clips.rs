//! Formats clips.

use std::fmt::{self, Write};

use gleaner_base::visible;
use gleaner_lambda::Clip;
use gleaner_protocol::ReplaySummary;
use gleaner_report::format::{clip_contents, clip_span, counted, seconds};

use super::{Paint, SHOWN, more};

/// Writes a block for each clip: its time, contents and gaps.
pub(super) fn write(
    text: &mut String,
    clips: &[Clip],
    summary: &ReplaySummary,
    paint: Paint,
) -> fmt::Result {
    if clips.is_empty() {
        return Ok(());
    }
    writeln!(text, "  {}", paint.bold(&counted(clips.len() as u64, "clip")))?;
    for clip in clips.iter().take(SHOWN) {
        let [from, to] = clip_span(clip).map(|at_ns| seconds(at_ns, summary.start_ns));
        one(text, clip, &format!("{from:>10.3} to {to:.3} s"), paint)?;
    }
    more(text, (clips.len() as u64).saturating_sub(SHOWN as u64))
}

/// Writes a block for one clip, headed by its time `when`.
pub(super) fn one(text: &mut String, clip: &Clip, when: &str, paint: Paint) -> fmt::Result {
    let file = visible(&clip.file.to_string_lossy());
    writeln!(text, "{}  {file}", paint.green(when))?;
    let thumbnail =
        clip.thumbnail.as_ref().map(|path| format!("; {}", visible(&path.to_string_lossy())));
    writeln!(text, "{:>14}{}{}", "", clip_contents(clip), thumbnail.unwrap_or_default())?;
    for why in &clip.incomplete {
        writeln!(text, "{:>14}{}", "", paint.yellow(&format!("incomplete: {}", visible(why))))?;
    }
    for loss in losses(clip) {
        writeln!(text, "{:>14}{}", "", paint.yellow(&format!("lost: {loss}")))?;
    }
    if let Some(recovered) = &clip.recovered {
        let what = format!(
            "recovered: {} ({} lost)",
            visible(&recovered.note),
            counted(recovered.lost_bytes, "byte")
        );
        writeln!(text, "{:>14}{}", "", paint.yellow(&what))?;
    }
    Ok(())
}

/// Returns a line for each topic with messages lost upstream. Losses of the recorder itself are in
/// `incomplete`.
fn losses(clip: &Clip) -> Vec<String> {
    let lost =
        clip.topics.iter().filter_map(|topic| Some((topic, topic.lost.filter(|lost| *lost > 0)?)));
    let lines = lost.map(|(topic, lost)| {
        format!("{} of {}, upstream", counted(lost, "message"), visible(&topic.topic))
    });
    lines.collect()
}
