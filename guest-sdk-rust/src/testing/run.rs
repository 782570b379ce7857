//! Runs a lambda in the fake host: delivers messages and collects the decisions.

use std::sync::Arc;

use gleaner_rules::faults::Faults;
use gleaner_rules::names::{COMPRESSED_IMAGE, IMAGE};
use gleaner_rules::text::quoted;

use super::data::{InputState, Tick};
use super::decision::{Cause, Decision, Fault, Trigger};
use super::error::Error;
use super::log::LogLine;
use super::message::{ENCAPSULATION, Message};
use super::path::known;
use super::ring::{Arrival, Cell};
use super::schedule::Schedule;
use super::session::{Session, attempt};
use crate::data::{Counts, Encoding, Guid, Sample, Value};
use crate::{Config, Lambda};

/// A loaded lambda with its decisions, log and counts so far.
///
/// Time is that of the messages, in nanoseconds: it advances only with [`Run::deliver`] and
/// [`Run::pass_to`].
pub struct Run<L: Lambda> {
    config: Config,
    session: Arc<Session>,
    schedule: Schedule,
    /// None after a fault, until the next wake.
    lambda: Option<L>,
    now_ns: Option<i64>,
    decisions: Vec<Decision>,
    faults: Faults,
}

/// A wake that is due.
enum DueWake {
    Event(Arc<InputState>, Arc<Cell>),
    Tick(Tick),
}

impl<L: Lambda> Run<L> {
    pub(super) fn start(
        name: &str,
        config: Config,
        session: Arc<Session>,
        schedule: Schedule,
    ) -> Result<Self, Error> {
        let (lambda, now_ns, decisions, faults) = (None, None, Vec::new(), Faults::default());
        let mut run = Self { config, session, schedule, lambda, now_ns, decisions, faults };
        match run.init() {
            Ok(()) => Ok(run),
            Err(fault) => {
                Err(Error::new(format!("cannot start lambda `{name}`"), fault.message, ""))
            }
        }
    }

    /// Delivers a message to an input at the time `at_ns`, in nanoseconds, and runs the lambda by
    /// its schedule: first the ticks that were due before, then once for the message, if it wakes
    /// the lambda. Returns the decisions of these wakes.
    ///
    /// # Errors
    ///
    /// If there is no such input, time would go back, or the message does not fit the input. The
    /// call has no effect then. A fault of the lambda is not an error: the decision contains it.
    pub fn deliver(
        &mut self,
        input: &str,
        at_ns: i64,
        message: Message,
    ) -> Result<&[Decision], Error> {
        let found = self.session.inputs.iter().position(|source| source.declared.name == input);
        let Some(number) = found else {
            let names =
                quoted(self.session.inputs.iter().map(|source| source.declared.name.as_str()));
            return Err(Error::new(
                format!("no input `{input}` to deliver to"),
                "",
                format!("the manifest has {names}"),
            ));
        };
        let source = Arc::clone(&self.session.inputs[number]);
        self.must_not_go_back(at_ns)?;
        let message = checked(&source, message)?;
        let before = source.lock().seq;
        let seq = message.seq.unwrap_or(before + 1);
        if seq <= before {
            let cause = format!("the previous message has the number {before}");
            return Err(Error::new(
                format!("message {seq} of input `{input}` is out of order"),
                cause,
                "increase the numbers",
            ));
        }
        self.now_ns = Some(at_ns);

        let decided = self.decisions.len();
        self.ticks(at_ns);
        {
            let arrived = &mut *source.lock();
            arrived.seq = seq;
            let writer = Guid {
                high: u64::from(u32::from_be_bytes(*b"test")) << 32,
                low: (number as u64) << 32,
            };
            let (publish_ns, bytes) =
                (message.publish_ns.unwrap_or(at_ns), message.bytes_at_least());
            arrived.ring.push(Arrival { at_ns, publish_ns, writer, seq, message }, bytes);
        }
        while let Some((source, cell)) = self.schedule.next_event() {
            self.wake(cell.sample.at_ns, DueWake::Event(source, cell));
        }
        Ok(&self.decisions[decided..])
    }

    /// Advances time to `at_ns`, in nanoseconds, without a message, and runs the ticks that are due
    /// up to and including that instant. Returns their decisions. The first tick is due a period
    /// after the first message or the first call of this method.
    ///
    /// # Errors
    ///
    /// If time would go back.
    pub fn pass_to(&mut self, at_ns: i64) -> Result<&[Decision], Error> {
        self.must_not_go_back(at_ns)?;
        let decided = self.decisions.len();
        if self.now_ns.replace(at_ns).is_none() {
            self.ticks(at_ns);
        }
        self.ticks(at_ns.saturating_add(1));
        Ok(&self.decisions[decided..])
    }

    /// Returns the decisions so far, one for each wake.
    pub fn decisions(&self) -> &[Decision] {
        &self.decisions
    }

    /// Returns the triggers so far, of all wakes.
    pub fn triggers(&self) -> impl Iterator<Item = &Trigger> {
        self.decisions.iter().flat_map(|decision| &decision.triggers)
    }

    /// Returns the faults so far. Check them in every test that expects none: without the check, a
    /// lambda that faults in each wake passes.
    pub fn faults(&self) -> impl Iterator<Item = &Fault> {
        self.decisions.iter().filter_map(|decision| decision.fault.as_ref())
    }

    /// Returns the log lines so far, of the lambda and of the host. Text that the lambda prints is
    /// not included: it goes to the output of the test.
    pub fn log(&self) -> Vec<LogLine> {
        self.session.lock().log.lines.clone()
    }

    /// Returns the numbers of received and lost samples of an input; none if there is no such
    /// input.
    pub fn counts(&self, input: &str) -> Option<Counts> {
        self.session
            .inputs
            .iter()
            .find(|source| source.declared.name == input)
            .map(|source| source.counts())
    }

    /// Returns the lambda; none after a fault, until the next wake creates a fresh instance.
    pub fn lambda(&self) -> Option<&L> {
        self.lambda.as_ref()
    }

    /// Returns the number of log lines dropped by the limits per second.
    pub fn log_dropped(&self) -> u64 {
        self.session.lock().log.dropped()
    }

    /// Returns the number of triggers refused by `events_per_minute`.
    pub fn triggers_refused(&self) -> u64 {
        self.session.lock().triggers.refused()
    }

    /// Returns the number of wakes skipped during back-off, after repeated faults.
    pub fn backed_off(&self) -> u64 {
        self.session.lock().backed_off
    }

    /// Returns the number of ticks that were due and did not run.
    pub fn missed_ticks(&self) -> u64 {
        self.schedule.missed()
    }

    fn must_not_go_back(&self, at_ns: i64) -> Result<(), Error> {
        match self.now_ns {
            Some(now_ns) if at_ns < now_ns => {
                let cause = format!("it is {now_ns} ns already");
                Err(Error::new(
                    format!("time cannot go back to {at_ns} ns"),
                    cause,
                    "deliver messages in the order of time",
                ))
            }
            _ => Ok(()),
        }
    }

    fn ticks(&mut self, now_ns: i64) {
        while let Some(tick) = self.schedule.next_tick(now_ns) {
            self.wake(tick.at_ns, DueWake::Tick(tick));
        }
    }

    fn init(&mut self) -> Result<(), Fault> {
        let (session, config) = (Arc::clone(&self.session), &self.config);
        self.lambda =
            Some(session.without_triggers(|| attempt(&session, "in init: ", || L::init(config)))?);
        Ok(())
    }

    /// Runs one wake and adds its decision. Triggers before a fault still count.
    fn wake(&mut self, at_ns: i64, due: DueWake) {
        if self.faults.is_backing_off(at_ns) {
            self.session.lock().backed_off += 1;
            return;
        }
        let mut decision = cause(at_ns, &due);
        {
            let state = &mut *self.session.lock();
            state.now_ns = at_ns;
            state.triggers.begin();
            if let Some(note) = self.faults.begin() {
                state.log.note(at_ns, note);
            }
        }
        decision.fault = self.run(due).err();
        decision.triggers = self.session.lock().triggers.end();
        if let Some(note) = self.faults.end(at_ns, decision.fault.is_some()) {
            self.session.lock().log.note(at_ns, note);
        }
        self.decisions.push(decision);
    }

    fn run(&mut self, due: DueWake) -> Result<(), Fault> {
        if self.lambda.is_none() {
            self.init()?;
        }
        let session = Arc::clone(&self.session);
        let lambda = self.lambda.as_mut().expect("it existed, or `init` has just created it");
        let ran = attempt(&session, "", || match due {
            DueWake::Event(source, cell) => lambda.on_event(Sample::from(source.sample(cell))),
            DueWake::Tick(tick) => lambda.on_tick(tick),
        });
        if ran.is_err() {
            // Drop it to release its handles. A component ends without running `drop`, so what
            // `drop` does here has no effect either.
            let lambda = self.lambda.take();
            let _ = session.without_triggers(|| dropped(&session, lambda));
        }
        ran
    }
}

impl<L: Lambda> Drop for Run<L> {
    fn drop(&mut self) {
        let (session, lambda) = (Arc::clone(&self.session), self.lambda.take());
        let _ = dropped(&session, lambda);
    }
}

/// Drops a lambda while it can still call the host.
fn dropped<L>(session: &Arc<Session>, lambda: Option<L>) -> Result<(), Fault> {
    attempt(session, "", || {
        drop(lambda);
        Ok(())
    })
}

fn cause(at_ns: i64, due: &DueWake) -> Decision {
    let (cause, woken_by) = match due {
        DueWake::Tick(_) => (Cause::Tick, None),
        DueWake::Event(source, cell) => (Cause::Event, Some((&source.declared, cell.sample.seq))),
    };
    Decision {
        at_ns,
        cause,
        input: woken_by.map(|(declared, _)| declared.name.clone()),
        topic: woken_by.map(|(declared, _)| declared.topic.clone()),
        seq: woken_by.map(|(_, seq)| seq),
        triggers: Vec::new(),
        fault: None,
    }
}

/// Validates a message and completes it: with the fields of its image, and the defaults of the
/// input.
fn checked(source: &InputState, mut message: Message) -> Result<Message, Error> {
    let (name, type_name) = (&source.declared.name, source.declared.type_name.as_str());
    let refuse = |cause: String, help: &str| {
        Err(Error::new(format!("cannot deliver a message to input `{name}`"), cause, help))
    };
    if message.cdr.as_ref().is_some_and(|cdr| cdr.len() < ENCAPSULATION) {
        return refuse(
            "its CDR is too short".to_owned(),
            "add the encapsulation header, four bytes before the message",
        );
    }
    if let Some(picture) = &message.picture {
        match type_name {
            IMAGE => message.set_image_fields(),
            COMPRESSED_IMAGE => {
                let needed = 3 * u64::from(picture.width) * u64::from(picture.height);
                let found = picture.data.len() as u64;
                if picture.encoding != Encoding::Rgb8 || found != needed || needed == 0 {
                    let cause = format!(
                        "{}x{} pixels of rgb8 have {needed} bytes",
                        picture.width, picture.height
                    );
                    let cause = format!(
                        "{cause}; it has {found} of {}",
                        crate::data::encoding_name(picture.encoding)
                    );
                    return refuse(cause, "set the decoded image: rgb8, without padding");
                }
            }
            _ => {
                let help =
                    format!("deliver an image to an input of `{IMAGE}` or `{COMPRESSED_IMAGE}`");
                return refuse(
                    format!("it is an image, and the input is of type `{type_name}`"),
                    &help,
                );
            }
        }
    }
    let Some(blank) = &source.blank else { return Ok(message) };
    for (path, value) in &mut message.fields {
        let Some(usual) = blank.fields.get(path) else {
            let cause = format!("its field `{path}` is not in the blank message of this input");
            return refuse(
                format!("{cause}{}", known(path, &blank.fields)),
                "correct the path, or add it to the blank message",
            );
        };
        if !fit(value, usual) {
            let cause = format!("its field `{path}` has another type than in the blank message");
            return refuse(cause, "use the same type in both");
        }
    }
    for (path, usual) in &blank.fields {
        message.fields.entry(path.clone()).or_insert_with(|| usual.clone());
    }
    Ok(message)
}

/// Returns whether `value` has the type of `usual`. Converts a number to that type if it keeps its
/// value.
fn fit(value: &mut Value, usual: &Value) -> bool {
    let made = match (&*value, usual) {
        (Value::Signed(number), Value::Real(_)) => Some(Value::Real(*number as f64)),
        (Value::Unsigned(number), Value::Real(_)) => Some(Value::Real(*number as f64)),
        (Value::Signed(number), Value::Unsigned(_)) => {
            u64::try_from(*number).ok().map(Value::Unsigned)
        }
        (Value::Unsigned(number), Value::Signed(_)) => {
            i64::try_from(*number).ok().map(Value::Signed)
        }
        (value, usual) => {
            return std::mem::discriminant(value) == std::mem::discriminant(usual);
        }
    };
    let fits = made.is_some();
    if let Some(made) = made {
        *value = made;
    }
    fits
}
