/* The part of Python's stable ABI that the extension module calls: what cffi generates needs no more.

   setup.py compiles with this file in place of Python's own header, which Debian and Ubuntu keep in a package apart
   (python3-dev): so the core builds wherever there is a C compiler. These names and types are fixed for all versions of
   Python 3 (PEP 384). A test compiles them beside the header of the Python that it runs in. */

#ifndef HC_PYTHON_H
#define HC_PYTHON_H

#include <alloca.h> /* as Python's header does, and cffi counts on */
#include <assert.h>
#include <stddef.h>
#include <string.h>
#include <sys/types.h>

#ifndef Py_PYTHON_H
#define PY_MAJOR_VERSION 3 /* asked by cffi up to 1.16 */
typedef ssize_t Py_ssize_t;
typedef struct _object PyObject;
typedef struct _ts PyThreadState;
#define PyMODINIT_FUNC __attribute__((visibility("default"))) PyObject *
#define Py_None (&_Py_NoneStruct)
#define Py_INCREF(object) Py_IncRef((PyObject *)(object))
#define Py_DECREF(object) Py_DecRef((PyObject *)(object))
#define Py_XDECREF(object) Py_DecRef((PyObject *)(object))
#define Py_BEGIN_ALLOW_THREADS { PyThreadState *saved_thread = PyEval_SaveThread();
#define Py_END_ALLOW_THREADS PyEval_RestoreThread(saved_thread); }
#endif

extern struct _object _Py_NoneStruct;
void Py_IncRef(PyObject *);
void Py_DecRef(PyObject *);
PyThreadState *PyEval_SaveThread(void);
void PyEval_RestoreThread(PyThreadState *);

int PyArg_UnpackTuple(PyObject *, const char *, Py_ssize_t, Py_ssize_t, ...);
PyObject *PyErr_Occurred(void);
void Py_FatalError(const char *) __attribute__((noreturn));
PyObject *PyImport_ImportModule(const char *);
PyObject *PyObject_CallMethod(PyObject *, const char *, const char *, ...);
void *PyObject_Malloc(size_t);
void PyObject_Free(void *);

PyObject *PyBool_FromLong(long);
PyObject *PyFloat_FromDouble(double);
double PyFloat_AsDouble(PyObject *);
PyObject *PyLong_FromLong(long);
PyObject *PyLong_FromLongLong(long long);
PyObject *PyLong_FromUnsignedLong(unsigned long);
PyObject *PyLong_FromUnsignedLongLong(unsigned long long);
PyObject *PyLong_FromVoidPtr(void *);

#endif
