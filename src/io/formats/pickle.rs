//! Pickles of Python that hold plain values and numpy arrays. Nothing in them is run: names of classes and
//! functions are only compared with those of numpy.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::rc::Rc;

use serde_json::{Map, Value};

/// The first byte of a pickle of protocol 2 and later.
pub(super) const PROTOCOL: u8 = 0x80;

/// A value on the pickle's stack.
#[derive(Clone, Debug)]
enum Item {
    Mark,
    Plain(Value),
    Bytes(Rc<[u8]>),
    List(Shared<Item>),
    Dict(Shared<(Item, Item)>),
    /// A class or function: module and name.
    Global(String),
    /// A call of one, with its arguments and the state that it got.
    Object(Rc<(Item, Item, Option<Item>)>),
}

/// A list or dict: what is put into it later is seen wherever it was named before.
type Shared<T> = Rc<RefCell<Vec<T>>>;

fn shared<T>(all: Vec<T>) -> Shared<T> {
    Rc::new(RefCell::new(all))
}

/// Lists, dicts and objects of a pickle, at most.
const MAX_CONTAINERS: usize = 20_000;
/// Values of the tree, at most.
const MAX_VALUES: usize = 200_000;
/// This many bytes of a text or array count as one value.
const BYTES_OF_VALUE: usize = 4000;

/// The pickle as a tree. Arrays are flat lists of their numbers, row by row.
///
/// # Errors
/// It is cut, holds something else than values and arrays, or is of a protocol that is not known.
pub(super) fn value(bytes: &[u8]) -> Result<Value, String> {
    let mut machine =
        Machine { bytes, at: 0, stack: Vec::new(), memo: BTreeMap::new(), containers: 0 };
    plain(&machine.run()?, 0, &mut 0)
}

struct Machine<'a> {
    bytes: &'a [u8],
    at: usize,
    stack: Vec<Item>,
    memo: BTreeMap<usize, Item>,
    /// Lists, dicts and objects so far.
    containers: usize,
}

impl Machine<'_> {
    fn run(&mut self) -> Result<Item, String> {
        loop {
            let at = self.at;
            match self.byte()? {
                b'.' => return self.pop(),
                code => self
                    .step(code)
                    .map_err(|what| format!("pickle, byte {at} (code {code:#x}): {what}"))?,
            }
        }
    }

    fn step(&mut self, code: u8) -> Result<(), String> {
        use Item::{Bytes, Dict, Global, List, Mark, Object, Plain};
        let item = match code {
            PROTOCOL => return self.take(1).map(drop),
            // A frame says its length, which is not needed.
            0x95 => return self.take(8).map(drop),
            b'(' => Mark,
            b'N' => Plain(Value::Null),
            0x88 | 0x89 => Plain(Value::Bool(code == 0x88)),
            b'K' => Plain(self.integer(1)?.into()),
            b'M' => Plain(self.integer(2)?.into()),
            b'J' => {
                let four = self.take(4)?;
                Plain(i32::from_le_bytes([four[0], four[1], four[2], four[3]]).into())
            }
            0x8a => {
                let size = self.integer(1)?;
                let digits = self.take(size)?;
                let sign = if digits.last().is_some_and(|last| *last > 127) { 0xff } else { 0 };
                let mut all = [sign; 8];
                all.get_mut(..size).ok_or("a number of more than 64 bits")?.copy_from_slice(digits);
                Plain(i64::from_le_bytes(all).into())
            }
            b'G' => {
                let mut eight = [0; 8];
                eight.copy_from_slice(self.take(8)?);
                Plain(f64::from_be_bytes(eight).into())
            }
            b'X' | 0x8c | 0x8d | b'U' | b'T' => {
                let size = match code {
                    0x8c | b'U' => 1,
                    0x8d => 8,
                    _ => 4,
                };
                let size = self.integer(size)?;
                let text = self.take(size)?;
                match code {
                    b'U' | b'T' => Bytes(text.into()),
                    _ => Plain(String::from_utf8_lossy(text).into_owned().into()),
                }
            }
            b'C' | b'B' | 0x8e | 0x96 => {
                let size = match code {
                    b'C' => 1,
                    b'B' => 4,
                    _ => 8,
                };
                let size = self.integer(size)?;
                Bytes(self.take(size)?.into())
            }
            b'}' => Dict(shared(Vec::new())),
            b']' | b')' => List(shared(Vec::new())),
            0x85..=0x87 => {
                let from = self.stack.len().checked_sub(usize::from(code - 0x84));
                List(shared(self.stack.split_off(from.ok_or("the stack is empty")?)))
            }
            b't' | b'l' => List(shared(self.marked()?)),
            // Protocol 0 has lines of text.
            b'V' => Plain(self.line()?.into()),
            b'a' | b'e' => {
                let more = if code == b'a' { vec![self.pop()?] } else { self.marked()? };
                let Some(List(list)) = self.stack.last() else { return Err("no list".into()) };
                list.borrow_mut().extend(more);
                return Ok(());
            }
            b's' | b'u' => {
                let more = match code {
                    b'u' => self.marked()?,
                    _ => {
                        let value = self.pop()?;
                        vec![self.pop()?, value]
                    }
                };
                let Some(Dict(dict)) = self.stack.last() else { return Err("no dict".into()) };
                dict.borrow_mut()
                    .extend(more.chunks_exact(2).map(|two| (two[0].clone(), two[1].clone())));
                return Ok(());
            }
            b'q' | b'r' | b'p' | 0x94 => {
                let place = match code {
                    b'q' => self.integer(1)?,
                    b'r' => self.integer(4)?,
                    b'p' => self.place()?,
                    _ => self.memo.len(),
                };
                self.memo.insert(place, self.stack.last().ok_or("the stack is empty")?.clone());
                return Ok(());
            }
            b'h' | b'j' | b'g' => {
                let place = match code {
                    b'h' => self.integer(1)?,
                    b'j' => self.integer(4)?,
                    _ => self.place()?,
                };
                self.memo.get(&place).ok_or("it names a value that is not there")?.clone()
            }
            b'c' => {
                let (module, name) = (self.line()?, self.line()?);
                Global(format!("{module}.{name}"))
            }
            0x93 => {
                let (name, module) = (self.pop()?, self.pop()?);
                let (Plain(Value::String(module)), Plain(Value::String(name))) = (module, name)
                else {
                    return Err("a class without a name".into());
                };
                Global(format!("{module}.{name}"))
            }
            b'R' => {
                let arguments = self.pop()?;
                Object(Rc::new((self.pop()?, arguments, None)))
            }
            b'b' => {
                let state = self.pop()?;
                let Object(bare) = self.pop()? else { return Err("a state of nothing".into()) };
                let whole = Object(Rc::new((bare.0.clone(), bare.1.clone(), Some(state))));
                for known in self.memo.values_mut() {
                    if matches!(known, Object(known) if Rc::ptr_eq(known, &bare)) {
                        *known = whole.clone();
                    }
                }
                whole
            }
            b'0' => return self.pop().map(drop),
            _ => return Err("only values and numpy arrays can be read".into()),
        };
        if matches!(item, List(_) | Dict(_) | Object(_)) {
            self.containers += 1;
            if self.containers > MAX_CONTAINERS {
                return Err("it holds too many lists and objects".into());
            }
        }
        self.stack.push(item);
        Ok(())
    }

    fn take(&mut self, count: usize) -> Result<&[u8], String> {
        let end = self.at.checked_add(count);
        let taken = end.and_then(|end| self.bytes.get(self.at..end)).ok_or("the file is cut")?;
        self.at += count;
        Ok(taken)
    }

    fn byte(&mut self) -> Result<u8, String> {
        Ok(self.take(1)?[0])
    }

    /// An unsigned number of so many bytes.
    fn integer(&mut self, size: usize) -> Result<usize, String> {
        Ok(self.take(size)?.iter().rev().fold(0, |sum, byte| (sum << 8) | usize::from(*byte)))
    }

    /// The number of a value in a line.
    fn place(&mut self) -> Result<usize, String> {
        self.line()?.parse().map_err(|_| "it names a value without a number".into())
    }

    fn line(&mut self) -> Result<String, String> {
        let rest = &self.bytes[self.at..];
        let end = rest.iter().position(|byte| *byte == b'\n').ok_or("the file is cut")?;
        let line = String::from_utf8_lossy(&rest[..end]).into_owned();
        self.at += end + 1;
        Ok(line)
    }

    fn pop(&mut self) -> Result<Item, String> {
        self.stack.pop().ok_or_else(|| "the stack is empty".into())
    }

    /// What is above the last mark.
    fn marked(&mut self) -> Result<Vec<Item>, String> {
        let mark = self.stack.iter().rposition(|item| matches!(item, Item::Mark));
        let above = self.stack.split_off(mark.ok_or("no mark")? + 1);
        self.stack.pop();
        Ok(above)
    }
}

/// Nesting below which a value is followed: a pickle can hold itself.
const MAX_DEPTH: usize = 32;

/// `count`: values so far; a pickle can name one value very often.
fn plain(item: &Item, depth: usize, count: &mut usize) -> Result<Value, String> {
    *count += 1;
    if depth > MAX_DEPTH || *count > MAX_VALUES {
        return Err("pickle: it holds too much".into());
    }
    // A value is copied once for each reference.
    *count += match item {
        Item::Plain(Value::String(text)) => text.len() / BYTES_OF_VALUE,
        Item::Bytes(bytes) => bytes.len() / BYTES_OF_VALUE,
        _ => 0,
    };
    let mut of = |item: &Item| plain(item, depth + 1, count);
    match item {
        Item::Plain(value) => Ok(value.clone()),
        Item::Bytes(bytes) => Ok(String::from_utf8_lossy(bytes).into_owned().into()),
        Item::List(all) => all.borrow().iter().map(of).collect(),
        Item::Dict(all) => {
            let field = |(key, value): &(Item, Item)| {
                let key = of(key)?;
                let key = key.as_str().map_or_else(|| key.to_string(), str::to_owned);
                Ok::<_, String>((key, of(value)?))
            };
            let fields = all.borrow().iter().map(field).collect::<Result<Map<_, _>, _>>()?;
            Ok(Value::Object(fields))
        }
        Item::Object(object) => numbers(object)
            .inspect(|all| {
                *count += all.as_array().map_or(0, Vec::len) * 8 / BYTES_OF_VALUE;
            })
            .ok_or_else(|| {
                let what = match &object.0 {
                    Item::Global(name) => name.as_str(),
                    _ => "an object",
                };
                format!("pickle: {what} is neither a plain value nor a numpy array of numbers")
            }),
        Item::Mark | Item::Global(_) => Err("pickle: a class where a value should be".into()),
    }
}

/// The numbers of a numpy array or of a numpy scalar.
fn numbers((called, arguments, state): &(Item, Item, Option<Item>)) -> Option<Value> {
    let (Item::Global(name), Item::List(arguments)) = (called, arguments) else { return None };
    let arguments = arguments.borrow();
    let is_text = |item: &Item, wanted: &str| matches!(item, Item::Plain(Value::String(text)) if text == wanted);
    let (kind, bytes, by_column, shape) = match (name.rsplit('.').next()?, state) {
        ("_reconstruct", Some(Item::List(state))) => {
            let state = state.borrow();
            let [_, shape, kind, by_column, bytes] = &state[..] else { return None };
            (kind.clone(), bytes.clone(), size(by_column) == Some(1), Some(shape.clone()))
        }
        // Protocol 5.
        ("_frombuffer", None) => {
            let [bytes, kind, shape, order] = &arguments[..] else { return None };
            (kind.clone(), bytes.clone(), is_text(order, "F"), Some(shape.clone()))
        }
        ("scalar", None) => (arguments.first()?.clone(), arguments.get(1)?.clone(), false, None),
        _ => return None,
    };
    let bytes: Rc<[u8]> = match bytes {
        Item::Bytes(bytes) => bytes.clone(),
        // Protocol 2 of Python 3: text in Latin 1, to be encoded.
        Item::Object(encoded) => match &encoded.1 {
            Item::List(all) => match all.borrow().first()? {
                Item::Plain(Value::String(text)) => text.chars().map(|c| c as u8).collect(),
                _ => return None,
            },
            _ => return None,
        },
        _ => return None,
    };
    let mut all = of_bytes(&bytes, &kind)?;
    if by_column && let Some(Item::List(shape)) = shape {
        let sizes = shape.borrow().iter().map(size).collect::<Option<Vec<_>>>()?;
        let sizes: Vec<usize> = sizes.into_iter().filter(|size| *size != 1).collect();
        match sizes[..] {
            [] | [_] => {}
            [rows, columns] if rows * columns == all.len() => {
                all = (0..all.len()).map(|i| all[i % columns * rows + i / columns]).collect();
            }
            _ => return None,
        }
    }
    Some(if name.ends_with("scalar") { Value::from(*all.first()?) } else { Value::from(all) })
}

/// A whole number or a truth value.
fn size(item: &Item) -> Option<usize> {
    match item {
        Item::Plain(Value::Number(number)) => usize::try_from(number.as_u64()?).ok(),
        Item::Plain(Value::Bool(is_so)) => Some(usize::from(*is_so)),
        _ => None,
    }
}

/// Numbers of a numpy type such as f8 or i4, little-endian.
fn of_bytes(bytes: &[u8], kind: &Item) -> Option<Vec<f64>> {
    let Item::Object(kind) = kind else { return None };
    let Item::List(arguments) = &kind.1 else { return None };
    let arguments = arguments.borrow();
    let Item::Plain(Value::String(code)) = arguments.first()? else { return None };
    if let Some(Item::List(state)) = &kind.2
        && matches!(state.borrow().get(1), Some(Item::Plain(Value::String(order))) if order == ">")
    {
        return None;
    }
    macro_rules! read {
        ($type:ty) => {{
            const SIZE: usize = size_of::<$type>();
            let one = |bytes: &[u8]| <$type>::from_le_bytes(bytes.try_into().unwrap_or([0; SIZE]));
            bytes.chunks_exact(SIZE).map(|bytes| one(bytes) as f64).collect()
        }};
    }
    Some(match &**code {
        "f8" => read!(f64),
        "f4" => read!(f32),
        "i8" => read!(i64),
        "i4" => read!(i32),
        "i2" => read!(i16),
        "u8" => read!(u64),
        "u4" => read!(u32),
        "u2" => read!(u16),
        "u1" => read!(u8),
        _ => return None,
    })
}
